import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { signInProblem } from "../../api/session";
import { signIn } from "../../state/begin";
import { Button } from "../ui/Button";
import { Sentence } from "../ui/Sentence";
import { Mark } from "../ui/Mark";

/** Shown where the service needs a token. */
export function SignIn() {
  const given = useSignal("");
  const field = useRef<HTMLInputElement>(null);
  useEffect(() => field.current?.focus(), []);
  const onSubmit = (event: SubmitEvent): void => {
    event.preventDefault();
    if (given.value.trim()) void signIn(given.value);
  };
  return (
    <main class="sign-in">
      <form onSubmit={onSubmit}>
        <Mark />
        <div>
          <h1>Deltalight</h1>
          <p class="quiet">This server accepts connections from other machines, so it asks for a token.</p>
        </div>
        {signInProblem.value && (
          <p role="alert">
            <Sentence text={signInProblem.value} />
          </p>
        )}
        <label class="field">
          <span class="field-label">Token</span>
          <input
            class="input"
            type="password"
            autocomplete="current-password"
            ref={field}
            value={given.value}
            onInput={(event) => (given.value = event.currentTarget.value)}
          />
        </label>
        <Button type="submit" kind="primary" disabled={!given.value.trim()}>
          Sign in
        </Button>
        <p class="quiet small">
          Create one with <code>deltalight api token NAME --role control</code>. This page keeps it until you close the
          tab.
        </p>
      </form>
    </main>
  );
}
