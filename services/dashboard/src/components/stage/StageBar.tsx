import { role } from "../../api/session";
import type { MethodName, View } from "../../api/types";
import { methods } from "../../forms/methods";
import { VIEWS } from "../../forms/views";
import { setMethod } from "../../state/actions";
import { standsOnSurfaces } from "../../state/preferences";
import { sceneDocument, setView, shownView } from "../../state/scene";
import { areOutlinesShown, isRoomShown, isSnapping, tool, type Tool } from "../../state/tools";
import { IconButton } from "../ui/IconButton";
import { Segments, type Segment } from "../ui/Segments";
import { Select } from "../ui/Select";
import { AddObjectButton } from "./AddObjectButton";
import { CameraSwitch } from "./CameraSwitch";

const TOOLS: readonly Segment<Tool>[] = [
  { value: "select", label: "Select", icon: "cursor", hint: "Q" },
  { value: "move", label: "Move", icon: "move", hint: "G" },
  { value: "rotate", label: "Rotate", icon: "rotate", hint: "R" },
  { value: "scale", label: "Scale", icon: "scale", hint: "S" },
  { value: "place", label: "Place on a surface", icon: "place", hint: "P" },
];

// Shown until the scene is read.
const NOTHING = { value: "" as never, label: "–" };

/** Tools over the picture, and what it shows. */
export function StageBar() {
  const document = sceneDocument.value;
  const isDisabled = role.value !== "control" || document === null;
  return (
    <div class="stage-bar" role="toolbar" aria-label="Tools">
      <Segments
        label="Tool"
        segments={TOOLS}
        value={tool.value}
        onChange={(next) => (tool.value = next)}
        disabled={isDisabled}
        compact
      />
      <IconButton
        icon="stand"
        label="Stand on surfaces"
        hint="F: dragged objects stand on what the camera sees"
        pressed={standsOnSurfaces.value}
        disabled={isDisabled}
        onClick={() => (standsOnSurfaces.value = !standsOnSurfaces.value)}
      />
      <IconButton
        icon="magnet"
        label="Snap to steps"
        hint="or hold Shift"
        pressed={isSnapping.value}
        disabled={isDisabled}
        onClick={() => (isSnapping.value = !isSnapping.value)}
      />
      <IconButton
        icon="frame"
        label="Outlines and lights"
        hint="H"
        pressed={areOutlinesShown.value}
        onClick={() => (areOutlinesShown.value = !areOutlinesShown.value)}
      />
      <IconButton
        icon="orbit"
        label="Room in 3-D"
        hint="O"
        pressed={isRoomShown.value}
        onClick={() => (isRoomShown.value = !isRoomShown.value)}
      />
      <AddObjectButton />
      <span class="grow" />
      <CameraSwitch />
      <Select<MethodName>
        label="Method"
        value={document?.method.name ?? NOTHING.value}
        choices={document ? methods.value.map(({ name, title }) => ({ value: name, label: title })) : [NOTHING]}
        onChange={setMethod}
        disabled={isDisabled}
      />
      <Select<View>
        label="View"
        value={shownView.value ?? NOTHING.value}
        choices={document ? VIEWS : [NOTHING]}
        onChange={setView}
        disabled={document === null}
      />
    </div>
  );
}
