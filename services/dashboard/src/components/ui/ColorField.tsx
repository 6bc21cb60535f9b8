import type { Vector } from "../../api/types";
import { hexFromLinear, linearFromHex } from "../../math/color";
import { Field } from "./Field";
import { NumberInput } from "./NumberInput";

interface ColorFieldProps {
  readonly label: string;
  readonly value: Vector;
  readonly onChange: (value: Vector) => void;
  readonly onEnd?: () => void;
  /** Greatest value of a channel. */
  readonly max: number;
  readonly help?: string;
  readonly disabled?: boolean;
}

const CHANNELS = ["red", "green", "blue"] as const;

/** A picker and the three linear values that the document holds. */
export function ColorField({ label, value, onChange, onEnd, max, help, disabled = false }: ColorFieldProps) {
  const change = (channel: number, next: number | null): void => {
    const changed = value.map((each, index) => (index === channel ? (next ?? each) : each));
    onChange(changed as unknown as Vector);
  };
  return (
    <Field label={label} unit="linear" help={help}>
      <div class="row" role="group" aria-label={label}>
        <input
          type="color"
          class="swatch"
          aria-label={`${label}, picker`}
          value={hexFromLinear(value)}
          disabled={disabled}
          onInput={(event) => onChange(linearFromHex(event.currentTarget.value, value))}
          onChange={onEnd}
        />
        <div class="vector grow">
          {CHANNELS.map((channel, index) => (
            <NumberInput
              key={channel}
              label={`${label} ${channel}`}
              value={value[index] ?? 0}
              onChange={(next) => change(index, next)}
              min={0}
              max={max}
              decimals={3}
              disabled={disabled}
              {...(onEnd ? { onEnd } : {})}
            />
          ))}
        </div>
      </div>
    </Field>
  );
}
