// Keys that hold everywhere but in fields.
import { role } from "../../api/session";
import { VIEWS } from "../../forms/views";
import { duplicateObject, removeLight, removeObject } from "../../state/actions";
import { redo, undo } from "../../state/history";
import { endNudge } from "../../state/nudge";
import { setView } from "../../state/scene";
import { standsOnSurfaces } from "../../state/preferences";
import { selectLight, selectedLight, selectedObjectId, selectObject } from "../../state/selection";
import { areOutlinesShown, isRoomShown, tool, type Tool } from "../../state/tools";
import { areKeysShown } from "./KeysDialog";

const TOOL_KEYS: Readonly<Record<string, Tool>> = {
  q: "select",
  g: "move",
  w: "move",
  r: "rotate",
  e: "rotate",
  s: "scale",
  p: "place",
};

export function listenToKeys(): () => void {
  document.addEventListener("keydown", onKeyDown);
  return () => document.removeEventListener("keydown", onKeyDown);
}

function onKeyDown(event: KeyboardEvent): void {
  if (event.defaultPrevented || isTyping(event.target) || document.querySelector("dialog[open]")) return;
  const key = event.key.toLowerCase();
  const done = event.ctrlKey || event.metaKey ? onControlKey(key, event.shiftKey) : !event.altKey && onPlainKey(key);
  if (done) event.preventDefault();
}

function isTyping(target: EventTarget | null): boolean {
  if (!(target instanceof HTMLElement)) return false;
  return (
    target.matches("input:not([type=radio], [type=checkbox], [type=range]), textarea, select") ||
    target.isContentEditable
  );
}

function onControlKey(key: string, shift: boolean): boolean {
  if (role.value !== "control") return false;
  endNudge();
  if (key === "z") void (shift ? redo() : undo());
  else if (key === "y") void redo();
  else if (key === "d" && selectedObjectId.value !== null) void duplicateObject(selectedObjectId.value);
  else return false;
  return true;
}

function onPlainKey(key: string): boolean {
  const nextTool = TOOL_KEYS[key];
  const nextView = VIEWS[Number(key) - 1];
  if (nextTool) tool.value = nextTool;
  else if (nextView) setView(nextView.value);
  else if (key === "f" && role.value === "control") standsOnSurfaces.value = !standsOnSurfaces.value;
  else if (key === "h") areOutlinesShown.value = !areOutlinesShown.value;
  else if (key === "o") isRoomShown.value = !isRoomShown.value;
  else if (key === "?") areKeysShown.value = true;
  else if (key === "escape") return leave();
  else if (key === "delete" || key === "backspace") return remove();
  else return false;
  return true;
}

function leave(): boolean {
  if (tool.value === "place" || tool.value === "shadow") tool.value = "move";
  else {
    selectObject(null);
    selectLight(null);
  }
  return true;
}

function remove(): boolean {
  if (role.value !== "control") return false;
  if (selectedObjectId.value !== null) void removeObject(selectedObjectId.value);
  else if (selectedLight.value !== null) void removeLight(selectedLight.value);
  else return false;
  return true;
}
