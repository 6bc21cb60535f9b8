import { useRef, useState } from "preact/hooks";
import { trimmed } from "../../math/units";

export interface NumberInputProps {
  readonly label: string;
  readonly value: number | null;
  /** null comes only where `empty` says what it means. */
  readonly onChange: (value: number | null) => void;
  readonly onEnd?: () => void;
  readonly min?: number | undefined;
  readonly max?: number | undefined;
  readonly step?: number;
  readonly decimals?: number;
  readonly integer?: boolean;
  readonly unit?: string;
  /** What an empty field means, such as "automatic". */
  readonly empty?: string;
  /** A letter before the number that can be dragged. */
  readonly grip?: "x" | "y" | "z";
  readonly disabled?: boolean;
}

// Pixels of dragging for one step.
const DRAG_PX = 4;

/** A number that is typed, stepped by arrow keys (Shift ten times, Alt a tenth) or dragged by its letter. */
export function NumberInput(props: NumberInputProps) {
  const { label, value, unit, grip, empty, disabled = false, decimals = 4, step = 0.01, integer = false } = props;
  const [typed, setTyped] = useState<string | null>(null);
  const drag = useRef<{ x: number; value: number } | null>(null);

  const give = (next: number): void => {
    const low = Math.max(next, props.min ?? -Infinity);
    const fitting = Math.min(low, props.max ?? Infinity);
    props.onChange(integer ? Math.round(fitting) : Number(fitting.toFixed(9)));
  };
  const finish = (): void => {
    if (typed !== null) {
      const number = Number(typed.replace(",", "."));
      if (typed.trim() === "" && empty !== undefined) props.onChange(null);
      else if (typed.trim() !== "" && Number.isFinite(number)) give(number);
    }
    setTyped(null);
    props.onEnd?.();
  };
  const onKeyDown = (event: KeyboardEvent): void => {
    if (event.key === "Enter") finish();
    else if (event.key === "Escape") setTyped(null);
    else if (event.key === "ArrowUp" || event.key === "ArrowDown") {
      event.preventDefault();
      const factor = event.shiftKey ? 10 : event.altKey && !integer ? 0.1 : 1;
      setTyped(null);
      give((value ?? 0) + (event.key === "ArrowUp" ? 1 : -1) * factor * step);
    }
  };
  const onGripDown = (event: PointerEvent): void => {
    if (disabled) return;
    (event.currentTarget as Element).setPointerCapture(event.pointerId);
    drag.current = { x: event.clientX, value: value ?? 0 };
  };
  const onGripMove = (event: PointerEvent): void => {
    if (!drag.current) return;
    give(drag.current.value + Math.round((event.clientX - drag.current.x) / DRAG_PX) * step);
  };
  const onGripUp = (): void => {
    drag.current = null;
    props.onEnd?.();
  };

  return (
    <div class="number">
      {grip && (
        <span
          class={`grip ${grip}`}
          aria-hidden="true"
          onPointerDown={onGripDown}
          onPointerMove={onGripMove}
          onPointerUp={onGripUp}
          onPointerCancel={onGripUp}
        >
          {grip.toUpperCase()}
        </span>
      )}
      <input
        type="text"
        inputMode="decimal"
        role="spinbutton"
        aria-label={label}
        aria-valuenow={value ?? undefined}
        aria-valuemin={props.min}
        aria-valuemax={props.max}
        aria-valuetext={value === null ? empty : `${trimmed(value, decimals)} ${unit ?? ""}`}
        placeholder={empty}
        disabled={disabled}
        value={typed ?? (value === null ? "" : trimmed(value, decimals))}
        onInput={(event) => setTyped(event.currentTarget.value)}
        onFocus={(event) => event.currentTarget.select()}
        onBlur={finish}
        onKeyDown={onKeyDown}
      />
      {unit && <span class="unit">{unit}</span>}
    </div>
  );
}
