interface SwitchProps {
  readonly label: string;
  /** Its name for screen readers, where the label stands elsewhere. */
  readonly name?: string;
  readonly checked: boolean;
  readonly onChange: (checked: boolean) => unknown;
  readonly disabled?: boolean;
}

export function Switch({ label, name, checked, onChange, disabled = false }: SwitchProps) {
  return (
    <label class="switch">
      <span>{label}</span>
      <input
        type="checkbox"
        role="switch"
        aria-label={name}
        checked={checked}
        disabled={disabled}
        onChange={(event) => onChange(event.currentTarget.checked)}
      />
    </label>
  );
}
