import { role } from "../../api/session";
import { needsToken, signOut } from "../../state/begin";
import { redo, undo } from "../../state/history";
import { isInspectorOpen, isTreeOpen } from "../../state/preferences";
import { areRoomsShown, hasRooms, shownRoom } from "../../state/rooms";
import { scene } from "../../state/scene";
import { theme, toggleTheme } from "../../state/theme";
import { Button } from "../ui/Button";
import { IconButton } from "../ui/IconButton";
import { Mark } from "../ui/Mark";
import { areKeysShown } from "./KeysDialog";
import { LiveState } from "./LiveState";
import { RecordButton } from "./RecordButton";
import { SceneMenu } from "./SceneMenu";
import { ShareButton } from "./ShareButton";
import { SnapshotButton } from "./SnapshotButton";

export function TopBar() {
  const mayChange = role.value === "control";
  const isDark = theme() === "dark";
  return (
    <header class="top">
      <IconButton
        icon="sidebar"
        label="Scene and assets"
        pressed={isTreeOpen.value}
        onClick={() => (isTreeOpen.value = !isTreeOpen.value)}
      />
      <h1 class="brand">
        <Mark />
        <span>Deltalight</span>
      </h1>
      {hasRooms.value && (
        <Button kind="plain" icon="room" title="All rooms" onClick={() => (areRoomsShown.value = true)}>
          {shownRoom.value?.title}
        </Button>
      )}
      <SceneMenu />
      <span class="rule" />
      <IconButton
        icon="undo"
        label="Undo"
        hint="Ctrl+Z"
        disabled={!mayChange || scene.value?.can_undo !== true}
        onClick={undo}
      />
      <IconButton
        icon="redo"
        label="Redo"
        hint="Ctrl+Shift+Z"
        disabled={!mayChange || scene.value?.can_redo !== true}
        onClick={redo}
      />
      <span class="grow" />
      {role.value === "view" && <span class="badge">view only</span>}
      <LiveState />
      <SnapshotButton />
      <ShareButton />
      <RecordButton />
      <span class="rule" />
      <IconButton icon="keyboard" label="Keyboard shortcuts" hint="?" onClick={() => (areKeysShown.value = true)} />
      <IconButton
        icon={isDark ? "sun" : "moon"}
        label={isDark ? "Light appearance" : "Dark appearance"}
        onClick={toggleTheme}
      />
      <IconButton
        icon="layers"
        label="Inspector"
        pressed={isInspectorOpen.value}
        onClick={() => (isInspectorOpen.value = !isInspectorOpen.value)}
      />
      {needsToken.value && <IconButton icon="close" label="Sign out" onClick={signOut} />}
    </header>
  );
}
