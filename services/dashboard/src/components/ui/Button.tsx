import type { ComponentChildren } from "preact";
import { Icon, type IconName } from "./Icon";

interface ButtonProps {
  readonly children: ComponentChildren;
  readonly onClick?: () => unknown;
  readonly icon?: IconName;
  readonly kind?: "primary" | "plain" | "danger";
  readonly disabled?: boolean;
  readonly type?: "button" | "submit";
  readonly title?: string;
}

export function Button({ children, onClick, icon, kind, disabled = false, type = "button", title }: ButtonProps) {
  return (
    <button type={type} class={`button ${kind ?? ""}`} disabled={disabled} title={title} onClick={() => onClick?.()}>
      {icon && <Icon name={icon} />}
      {children}
    </button>
  );
}
