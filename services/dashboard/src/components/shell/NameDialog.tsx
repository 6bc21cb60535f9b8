import { signal } from "@preact/signals";
import { useState } from "preact/hooks";
import { Button } from "../ui/Button";
import { Dialog } from "../ui/Dialog";

interface Question {
  readonly title: string;
  readonly initial: string;
  readonly onName: (name: string) => unknown;
}

const question = signal<Question | null>(null);

export function askName(asked: Question): void {
  question.value = asked;
}

/** Asks for the name of a scene. */
export function NameDialog() {
  const asked = question.value;
  return asked && <Form key={asked.title} {...asked} />;
}

function Form({ title, initial, onName }: Question) {
  const [typed, setTyped] = useState(initial);
  const name = typed.trim();
  const close = (): void => void (question.value = null);
  const onSubmit = (event: SubmitEvent): void => {
    event.preventDefault();
    if (!name) return;
    close();
    onName(name);
  };
  return (
    <Dialog title={title} onClose={close}>
      <form class="name-form" onSubmit={onSubmit}>
        <input
          class="input"
          aria-label="Name"
          maxLength={200}
          value={typed}
          onInput={(event) => setTyped(event.currentTarget.value)}
          onFocus={(event) => event.currentTarget.select()}
        />
        <Button type="submit" kind="primary" disabled={!name}>
          OK
        </Button>
      </form>
    </Dialog>
  );
}
