import type { Vector } from "../../api/types";
import { Field } from "./Field";
import { NumberInput } from "./NumberInput";

interface VectorInputProps {
  readonly label: string;
  readonly unit?: string;
  readonly help?: string;
  readonly value: Vector;
  readonly onChange: (value: Vector) => void;
  readonly onEnd?: () => void;
  readonly step?: number;
  readonly decimals?: number;
  readonly disabled?: boolean;
}

const AXES = ["x", "y", "z"] as const;

export function VectorInput({ label, unit, help, value, onChange, onEnd, step, decimals, disabled }: VectorInputProps) {
  const change = (axis: number, next: number | null): void => {
    const moved = value.map((each, index) => (index === axis ? (next ?? each) : each));
    onChange(moved as unknown as Vector);
  };
  return (
    <Field label={label} {...(unit ? { unit } : {})} help={help}>
      <div class="vector" role="group" aria-label={label}>
        {AXES.map((axis, index) => (
          <NumberInput
            key={axis}
            label={`${label} ${axis}`}
            grip={axis}
            value={value[index] ?? 0}
            onChange={(next) => change(index, next)}
            {...(onEnd ? { onEnd } : {})}
            {...(step === undefined ? {} : { step })}
            {...(decimals === undefined ? {} : { decimals })}
            {...(disabled === undefined ? {} : { disabled })}
          />
        ))}
      </div>
    </Field>
  );
}
