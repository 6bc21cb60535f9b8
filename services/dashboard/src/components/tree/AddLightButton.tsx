import { role } from "../../api/session";
import type { LightType } from "../../api/types";
import { LIGHT_TYPES } from "../../forms/lights";
import { addLight } from "../../state/actions";
import { beginShadowLight } from "../../state/shadowLight";
import { lights } from "../../state/scene";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";

export function AddLightButton() {
  if (lights.value?.mode !== "manual") return null;
  const entries = (Object.keys(LIGHT_TYPES) as LightType[]).map((type): MenuEntry => ({
    label: LIGHT_TYPES[type].label,
    icon: LIGHT_TYPES[type].icon,
    onClick: () => addLight(type),
  }));
  entries.push({ label: "From a shadow…", icon: "place", begins: true, onClick: beginShadowLight });
  return (
    <Menu label="Add light" entries={entries} side="right" kind="icon-only plain" disabled={role.value !== "control"}>
      <Icon name="add" />
    </Menu>
  );
}
