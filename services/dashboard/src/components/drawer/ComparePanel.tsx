import { computed, useSignal, type Signal } from "@preact/signals";
import { API } from "../../api/http";
import { role } from "../../api/session";
import type { MethodName, Snapshot, WantedPicture } from "../../api/types";
import { methods } from "../../forms/methods";
import { methodOf } from "../../state/actions";
import { comparison, type Side } from "../../state/comparison";
import { noteTried } from "../../state/preferences";
import { isTakingSnapshot, takeSnapshot } from "../../state/takes";
import { toast } from "../../state/toasts";
import { Button } from "../ui/Button";
import { Field } from "../ui/Field";
import { Select } from "../ui/Select";

/** The camera's own picture, or the composite by a method. */
type Choice = "camera" | MethodName;

const choices = computed<readonly { readonly value: Choice; readonly label: string }[]>(() => [
  { value: "camera", label: "Camera (before)" },
  ...methods.value.map(({ name, title }) => ({ value: name, label: title })),
]);

/** Renders one frame twice and lays both over the live picture, with a split to slide. */
export function ComparePanel() {
  const a = useSignal<Choice>("camera");
  const b = useSignal<Choice>("dvct");
  const compare = async (): Promise<void> => {
    const taken = await takeSnapshot([pictureOf("a", a.value), pictureOf("b", b.value)], false);
    if (!taken) return;
    const sides = [sideOf(taken, "a", a.value), sideOf(taken, "b", b.value)] as const;
    if (!sides[0] || !sides[1]) return;
    comparison.value = { a: sides[0], b: sides[1], frameId: taken.frame_id };
    noteTried("compare");
  };
  const isBusy = isTakingSnapshot.value;
  return (
    <div class="compare-panel">
      <SideChoice label="Left (A)" choice={a} />
      <SideChoice label="Right (B)" choice={b} />
      <div class="row">
        <Button kind="primary" icon="compare" disabled={role.value !== "control" || isBusy} onClick={compare}>
          {isBusy ? "Rendering both…" : "Compare this frame"}
        </Button>
        {comparison.value && <Button onClick={() => (comparison.value = null)}>Back to live</Button>}
      </div>
      <p class="quiet small">
        Both sides show the same frame. Drag the split across the picture, or focus it and use the arrow keys. Both
        pictures are kept under Snapshots.
      </p>
    </div>
  );
}

function SideChoice({ label, choice }: { readonly label: string; readonly choice: Signal<Choice> }) {
  return (
    <Field label={label}>
      <Select
        label={label}
        value={choice.value}
        choices={choices.value}
        onChange={(next) => (choice.value = next)}
        disabled={role.value !== "control"}
      />
    </Field>
  );
}

function pictureOf(name: string, choice: Choice): WantedPicture {
  return choice === "camera" ? { name, view: "camera" } : { name, view: "composite", method: methodOf(choice) };
}

/** A picture of the snapshot; why it could not be rendered is told. */
function sideOf(taken: Snapshot, name: string, choice: Choice): Side | null {
  const picture = taken.pictures.find((each) => each.name === name);
  if (picture?.file) return { label: labelOf(choice), path: `${API}/snapshots/${taken.id}/${picture.file}` };
  toast(`${labelOf(choice)}: ${picture?.detail ?? "this picture could not be rendered."}`, "error");
  return null;
}

function labelOf(choice: Choice): string {
  return choices.value.find((each) => each.value === choice)?.label ?? choice;
}
