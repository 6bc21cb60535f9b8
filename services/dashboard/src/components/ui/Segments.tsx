import { useId } from "preact/hooks";
import { Icon, type IconName } from "./Icon";

export interface Segment<T extends string> {
  readonly value: T;
  readonly label: string;
  readonly icon?: IconName;
  readonly hint?: string;
  /** Why it cannot be chosen. */
  readonly reason?: string | undefined;
}

interface SegmentsProps<T extends string> {
  readonly label: string;
  readonly value: T;
  readonly segments: readonly Segment<T>[];
  readonly onChange: (value: T) => unknown;
  /** Icons alone; the labels stay for screen readers and tips. */
  readonly compact?: boolean;
  readonly disabled?: boolean;
}

/** One of a few, side by side; real radio buttons, so that keys work as everywhere. */
export function Segments<T extends string>(props: SegmentsProps<T>) {
  const { label, value, segments, onChange, compact = false, disabled = false } = props;
  const name = useId();
  return (
    <div class="segments" role="radiogroup" aria-label={label}>
      {segments.map((segment) => (
        <label key={segment.value} title={tipOf(segment)}>
          <input
            type="radio"
            name={name}
            aria-label={segment.label}
            checked={segment.value === value}
            disabled={disabled || segment.reason !== undefined}
            onChange={() => onChange(segment.value)}
          />
          {segment.icon && <Icon name={segment.icon} />}
          {!compact && <span class="cut">{segment.label}</span>}
        </label>
      ))}
    </div>
  );
}

function tipOf({ label, hint, reason }: Segment<string>): string {
  return reason ?? (hint ? `${label} (${hint})` : label);
}
