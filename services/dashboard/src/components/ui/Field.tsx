import type { ComponentChildren } from "preact";
import { useId } from "preact/hooks";
import { useSignal } from "@preact/signals";
import { Icon } from "./Icon";
import { Sentence } from "./Sentence";

interface FieldProps {
  readonly label: string;
  readonly unit?: string;
  /** A sentence that the icon beside the label shows. */
  readonly help?: string | undefined;
  /** Label and control in one line. */
  readonly inline?: boolean;
  readonly children: ComponentChildren;
}

/** A label with its control; the control names itself, since some fields hold several. */
export function Field({ label, unit, help, inline = false, children }: FieldProps) {
  const isOpen = useSignal(false);
  const id = useId();
  return (
    <div class={inline ? "inline-field" : "field"}>
      <div class="field-label">
        <span>{label}</span>
        {unit && <span class="unit">{unit}</span>}
        {help && (
          <button
            type="button"
            class="info"
            aria-label={`About ${label}`}
            aria-expanded={isOpen.value}
            aria-controls={id}
            onClick={() => (isOpen.value = !isOpen.value)}
          >
            <Icon name="info" />
          </button>
        )}
      </div>
      {inline ? null : isOpen.value && <Hint id={id} text={help} />}
      {children}
      {inline && isOpen.value && <Hint id={id} text={help} />}
    </div>
  );
}

function Hint({ id, text }: { readonly id: string; readonly text: string | undefined }) {
  return (
    <p class="hint" id={id}>
      {text && <Sentence text={text} />}
    </p>
  );
}
