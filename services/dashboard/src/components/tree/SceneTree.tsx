import { role } from "../../api/session";
import type { Surface } from "../../api/types";
import { LIGHT_TYPES } from "../../forms/lights";
import { removeLight, removeObject, setVisible } from "../../state/actions";
import { isSceneRead, lights, objects, sceneDocument } from "../../state/scene";
import {
  inspectorTab,
  selectedLight,
  selectedObjectId,
  selectLight,
  selectObject,
  selectReal,
} from "../../state/selection";
import { Skeleton } from "../ui/Skeleton";
import { IconButton } from "../ui/IconButton";
import { TreeGroup } from "./TreeGroup";
import { TreeItem } from "./TreeItem";
import { AddLightButton } from "./AddLightButton";

const MODES = {
  manual: "",
  fisheye: "Fish-eye camera",
  tracked: "Tracked lamps",
  environment: "Environment map",
} as const;

/** Objects, lights and real surfaces; arrow keys walk through all of them. */
export function SceneTree() {
  const document = sceneDocument.value;
  if (!isSceneRead.value) return <Skeleton lines={6} />;
  return (
    <div class="scroll" onKeyDown={walk}>
      <TreeGroup title="Objects" empty={objects.value.length > 0 ? null : noObjects()}>
        {objects.value.map((item) => (
          <ObjectItem key={item.id} id={item.id} visible={item.visible} />
        ))}
      </TreeGroup>
      <TreeGroup title="Lights" action={<AddLightButton />} empty={hasLights() ? null : "No lights."}>
        <LightItems />
      </TreeGroup>
      <TreeGroup title="Real scene" empty={document ? null : "No scene is open."}>
        <TreeItem
          icon="room"
          label={geometryText(document?.real.geometry)}
          isSelected={isRealShown()}
          onSelect={selectReal}
        />
        {document?.real.surfaces.map((surface, index) => (
          <TreeItem
            key={index}
            icon="layers"
            label={`Surface ${index + 1}: ${regionText(surface)}`}
            isSelected={false}
            onSelect={selectReal}
          />
        ))}
      </TreeGroup>
    </div>
  );
}

function noObjects(): string {
  return role.value === "control" ? "None yet. Drop a .glb onto the picture." : "None yet.";
}

function ObjectItem({ id, visible }: { readonly id: string; readonly visible: boolean }) {
  const mayChange = role.value === "control";
  return (
    <TreeItem
      icon="box"
      label={id}
      isDimmed={!visible}
      isSelected={selectedObjectId.value === id}
      onSelect={() => selectObject(id)}
      {...(mayChange ? { onRemove: () => removeObject(id), onToggle: () => setVisible(id, !visible) } : {})}
    >
      <IconButton
        icon={visible ? "eye" : "hidden"}
        label={visible ? `Hide ${id}` : `Show ${id}`}
        tabIndex={-1}
        disabled={!mayChange}
        onClick={() => setVisible(id, !visible)}
      />
    </TreeItem>
  );
}

function hasLights(): boolean {
  return lights.value !== null && (lights.value.mode !== "manual" || lights.value.manual.length > 0);
}

function LightItems() {
  const found = lights.value;
  if (!found) return null;
  if (found.mode !== "manual") {
    return (
      <TreeItem
        icon="sun"
        label={MODES[found.mode]}
        isSelected={inspectorTab.value === "lights"}
        onSelect={() => (inspectorTab.value = "lights")}
      />
    );
  }
  return (
    <>
      {found.manual.map((light, index) => (
        <TreeItem
          key={index}
          icon={LIGHT_TYPES[light.type].icon}
          label={`${LIGHT_TYPES[light.type].label} ${index + 1}`}
          color={light.color_linear}
          isSelected={selectedLight.value === index}
          onSelect={() => selectLight(index)}
          {...(role.value === "control" ? { onRemove: () => removeLight(index) } : {})}
        />
      ))}
    </>
  );
}

function regionText({ region }: Surface): string {
  if (region?.sheet) return "sheet";
  return region?.material ?? (region?.box ? "box" : "plane");
}

function isRealShown(): boolean {
  return inspectorTab.value === "real" && selectedObjectId.value === null && selectedLight.value === null;
}

function geometryText(geometry: unknown): string {
  if (geometry === "depth") return "Depth of each frame";
  return geometry === "fused" ? "Depth of all frames" : "Given model";
}

function walk(event: KeyboardEvent): void {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  const root = event.currentTarget as HTMLElement;
  const items = [...root.querySelectorAll<HTMLElement>("[role=treeitem]")];
  const index = items.indexOf(document.activeElement as HTMLElement);
  if (index < 0) return;
  const next = event.key === "Home" ? items[0] : event.key === "End" ? items.at(-1) : step && items[index + step];
  if (!next) return;
  event.preventDefault();
  next.focus();
}
