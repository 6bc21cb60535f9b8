import { Field } from "./Field";
import { NumberInput } from "./NumberInput";

interface SliderFieldProps {
  readonly label: string;
  readonly value: number;
  readonly onChange: (value: number) => void;
  readonly onEnd?: () => void;
  /** Range of the slider; the number may go to `numberMax`. */
  readonly min: number;
  readonly max: number;
  readonly numberMax?: number;
  readonly step?: number;
  readonly unit?: string;
  readonly help?: string;
  readonly disabled?: boolean;
}

export function SliderField(props: SliderFieldProps) {
  const { label, value, onChange, onEnd, min, max, step = 0.01, unit, help, disabled = false } = props;
  const share = Math.max(0, Math.min(1, (value - min) / (max - min)));
  return (
    <Field label={label} help={help}>
      <div class="slider">
        <input
          type="range"
          aria-label={`${label}, slider`}
          min={min}
          max={max}
          step={step}
          value={value}
          disabled={disabled}
          ref={(element) => element?.style.setProperty("--filled", `${100 * share}%`)}
          onInput={(event) => onChange(event.currentTarget.valueAsNumber)}
          onChange={onEnd}
        />
        <NumberInput
          label={label}
          value={value}
          onChange={(next) => next !== null && onChange(next)}
          min={min}
          max={props.numberMax ?? max}
          step={step}
          disabled={disabled}
          {...(unit ? { unit } : {})}
          {...(onEnd ? { onEnd } : {})}
        />
      </div>
    </Field>
  );
}
