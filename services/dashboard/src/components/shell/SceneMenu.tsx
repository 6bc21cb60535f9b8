import { useRef } from "preact/hooks";
import { API, request } from "../../api/http";
import { role } from "../../api/session";
import type { SceneAnswer } from "../../api/types";
import { activateScene, deleteScene, duplicateScene, newScene, renameScene } from "../../state/actions";
import { isSceneRead, scene, sceneDocument, scenes } from "../../state/scene";
import { attempt } from "../../state/toasts";
import { askName } from "./NameDialog";
import { download } from "../ui/download";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";

/** The scene that is shown; a menu to choose another, make, copy, import and export. */
export function SceneMenu() {
  const file = useRef<HTMLInputElement>(null);
  const current = scene.value;
  const name = sceneDocument.value?.name ?? "";
  const shown = current ? name || "untitled" : isSceneRead.value ? "No scene" : "…";
  const mayChange = role.value === "control";
  const others = scenes.value.map((each): MenuEntry => ({
    label: each.name || "untitled",
    ...(each.id === current?.id ? { icon: "check" as const } : {}),
    end: `r${each.revision}`,
    disabled: !mayChange,
    onClick: () => activateScene(each.id),
  }));
  const entries: MenuEntry[] = [
    ...others,
    {
      label: "New scene…",
      icon: "add",
      begins: true,
      disabled: !mayChange,
      onClick: () => askName({ title: "New scene", initial: "My scene", onName: newScene }),
    },
    {
      label: "Rename this scene…",
      icon: "frame",
      disabled: !mayChange || !current,
      onClick: () => askName({ title: "Rename the scene", initial: name, onName: renameScene }),
    },
    {
      label: "Duplicate this scene",
      icon: "copy",
      disabled: !mayChange || !current,
      onClick: () => current && duplicateScene(current.id),
    },
    { label: "Import a scene…", icon: "upload", disabled: !mayChange, onClick: () => file.current?.click() },
    {
      label: "Export as JSON",
      icon: "download",
      disabled: !current,
      onClick: () => current && exportScene(current.id, name),
    },
    ...deletions(current?.id, mayChange),
  ];
  return (
    <>
      <Menu label={`Scenes: ${shown}`} entries={entries}>
        <span class="cut scene-name">{shown}</span>
        <Icon name="down" />
      </Menu>
      <input
        ref={file}
        type="file"
        accept=".json,.yaml,.yml"
        hidden
        onChange={(event) => void importScene(event.currentTarget)}
      />
    </>
  );
}

function deletions(currentId: string | undefined, mayChange: boolean): MenuEntry[] {
  return scenes.value
    .filter((each) => each.id !== currentId)
    .map((each, index): MenuEntry => ({
      label: `Delete ${each.name || "untitled"}`,
      icon: "trash",
      begins: index === 0,
      disabled: !mayChange,
      onClick: () => deleteScene(each.id),
    }));
}

async function exportScene(id: string, name: string): Promise<void> {
  await download(`${API}/scenes/${id}/document`, `${name || "scene"}.json`);
}

async function importScene(input: HTMLInputElement): Promise<void> {
  const file = input.files?.[0];
  input.value = "";
  if (!file) return;
  const type = file.name.endsWith(".json") ? "application/json" : "application/yaml";
  const body = await file.text();
  const made = await attempt(() => request<SceneAnswer>("POST", `${API}/scenes`, { body, type }));
  if (made) await activateScene(made.id);
}
