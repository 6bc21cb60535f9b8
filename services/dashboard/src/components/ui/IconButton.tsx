import { Icon, type IconName } from "./Icon";

interface IconButtonProps {
  readonly icon: IconName;
  readonly label: string;
  readonly onClick: () => unknown;
  /** The key that does the same, shown in the tip. */
  readonly hint?: string;
  readonly pressed?: boolean;
  readonly disabled?: boolean;
  readonly tabIndex?: number;
}

export function IconButton({ icon, label, onClick, hint, pressed, disabled = false, tabIndex }: IconButtonProps) {
  return (
    <button
      type="button"
      class="button plain icon-only"
      aria-label={label}
      aria-pressed={pressed}
      title={hint ? `${label} (${hint})` : label}
      disabled={disabled}
      tabIndex={tabIndex}
      onClick={(event) => {
        event.stopPropagation();
        onClick();
      }}
    >
      <Icon name={icon} />
    </button>
  );
}
