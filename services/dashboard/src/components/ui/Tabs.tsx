import { Icon, type IconName } from "./Icon";

export interface Tab<T extends string> {
  readonly value: T;
  readonly label: string;
  readonly icon?: IconName;
}

interface TabsProps<T extends string> {
  readonly label: string;
  readonly tabs: readonly Tab<T>[];
  /** null: none is open. */
  readonly value: T | null;
  readonly onChange: (value: T) => void;
  readonly panelId: string;
}

/** A row of tabs with roving focus: arrow keys, Home and End. */
export function Tabs<T extends string>({ label, tabs, value, onChange, panelId }: TabsProps<T>) {
  const onKeyDown = (event: KeyboardEvent, index: number): void => {
    const last = tabs.length - 1;
    const moves: Record<string, number> = {
      ArrowRight: index === last ? 0 : index + 1,
      ArrowLeft: index === 0 ? last : index - 1,
      Home: 0,
      End: last,
    };
    const next = tabs[moves[event.key] ?? -1];
    if (!next) return;
    event.preventDefault();
    onChange(next.value);
    const row = (event.currentTarget as HTMLElement).parentElement;
    row?.querySelectorAll<HTMLElement>("[role=tab]")[tabs.indexOf(next)]?.focus();
  };
  return (
    <div class="tabs" role="tablist" aria-label={label}>
      {tabs.map((tab, index) => (
        <button
          key={tab.value}
          type="button"
          class="tab"
          role="tab"
          id={`${panelId}-${tab.value}`}
          aria-label={tab.label}
          title={tab.icon && tab.label}
          aria-selected={tab.value === value}
          aria-controls={panelId}
          tabIndex={tab.value === value || (value === null && index === 0) ? 0 : -1}
          onClick={() => onChange(tab.value)}
          onKeyDown={(event) => onKeyDown(event, index)}
        >
          {tab.icon && <Icon name={tab.icon} />}
          <span class="tab-label">{tab.label}</span>
        </button>
      ))}
    </div>
  );
}
