import type { ComponentChildren } from "preact";
import type { Vector } from "../../api/types";
import { hexFromLinear } from "../../math/color";
import { Icon, type IconName } from "../ui/Icon";

interface TreeItemProps {
  readonly icon: IconName;
  readonly label: string;
  readonly isSelected: boolean;
  readonly isDimmed?: boolean;
  /** The colour of a light. */
  readonly color?: Vector;
  readonly onSelect: () => void;
  readonly onRemove?: () => unknown;
  readonly onToggle?: () => unknown;
  readonly children?: ComponentChildren;
}

export function TreeItem(props: TreeItemProps) {
  const { icon, label, isSelected, isDimmed = false, color, onSelect } = props;
  const onKeyDown = (event: KeyboardEvent): void => {
    const act = { Enter: onSelect, " ": props.onToggle ?? onSelect, Delete: props.onRemove, Backspace: props.onRemove }[
      event.key
    ];
    if (!act || event.target !== event.currentTarget) return;
    event.preventDefault();
    event.stopPropagation();
    act();
  };
  return (
    <div
      class={`tree-item ${isDimmed ? "dimmed" : ""}`}
      role="treeitem"
      aria-selected={isSelected}
      aria-label={label}
      tabIndex={0}
      onClick={onSelect}
      onKeyDown={onKeyDown}
    >
      <Icon name={icon} />
      <span class="cut grow">{label}</span>
      {color && <i class="tree-color" style={{ background: hexFromLinear(color) }} />}
      {props.children}
    </div>
  );
}
