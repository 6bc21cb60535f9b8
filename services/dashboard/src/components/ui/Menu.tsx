import type { ComponentChildren } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { useSignal } from "@preact/signals";
import { Icon, type IconName } from "./Icon";

export interface MenuEntry {
  readonly label: string;
  readonly icon?: IconName;
  readonly onClick: () => unknown;
  readonly disabled?: boolean;
  readonly end?: string;
  /** A line above it. */
  readonly begins?: boolean;
}

interface MenuProps {
  readonly label: string;
  readonly entries: readonly MenuEntry[];
  readonly children: ComponentChildren;
  readonly side?: "left" | "right";
  readonly kind?: "plain" | "primary" | "icon-only plain";
  readonly disabled?: boolean;
}

/** A button that opens a menu; arrow keys walk through it, Escape closes it. */
export function Menu({ label, entries, children, side = "left", kind = "plain", disabled = false }: MenuProps) {
  const isOpen = useSignal(false);
  const root = useRef<HTMLDivElement>(null);
  const button = useRef<HTMLButtonElement>(null);

  useEffect(() => {
    const close = (event: Event): void => {
      if (!root.current?.contains(event.target as Node)) isOpen.value = false;
    };
    document.addEventListener("pointerdown", close);
    return () => document.removeEventListener("pointerdown", close);
  }, [isOpen]);
  useEffect(() => {
    if (isOpen.value) items(root.current)[0]?.focus();
  }, [isOpen.value]);

  const onKeyDown = (event: KeyboardEvent): void => {
    if (!isOpen.value) return;
    event.stopPropagation();
    if (event.key === "Escape" || event.key === "Tab") {
      isOpen.value = false;
      button.current?.focus();
    } else if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      event.preventDefault();
      walk(items(root.current), event.key === "ArrowDown" ? 1 : -1);
    }
  };
  const choose = (entry: MenuEntry): void => {
    isOpen.value = false;
    button.current?.focus();
    entry.onClick();
  };
  return (
    <div class="menu" ref={root} onKeyDown={onKeyDown}>
      <button
        type="button"
        ref={button}
        class={`button ${kind}`}
        aria-label={label}
        title={label}
        aria-haspopup="menu"
        aria-expanded={isOpen.value}
        disabled={disabled}
        onClick={() => (isOpen.value = !isOpen.value)}
      >
        {children}
      </button>
      {isOpen.value && (
        <div class={`menu-items ${side}`} role="menu" aria-label={label}>
          {entries.map((entry) => (
            <MenuRow key={entry.label} entry={entry} onChoose={() => choose(entry)} />
          ))}
        </div>
      )}
    </div>
  );
}

function MenuRow({ entry, onChoose }: { readonly entry: MenuEntry; readonly onChoose: () => void }) {
  return (
    <>
      {entry.begins && <hr />}
      <button
        type="button"
        class="menu-item"
        role="menuitem"
        tabIndex={-1}
        disabled={entry.disabled}
        onClick={onChoose}
      >
        {entry.icon && <Icon name={entry.icon} />}
        <span class="cut">{entry.label}</span>
        {entry.end && <span class="end">{entry.end}</span>}
      </button>
    </>
  );
}

function items(root: HTMLElement | null): HTMLElement[] {
  return root ? [...root.querySelectorAll<HTMLElement>("[role=menuitem]:not(:disabled)")] : [];
}

function walk(all: readonly HTMLElement[], step: number): void {
  const index = all.indexOf(document.activeElement as HTMLElement);
  all[(index + step + all.length) % all.length]?.focus();
}
