import { useEffect } from "preact/hooks";
import { isInspectorOpen, isTreeOpen } from "../../state/preferences";
import { Drawer } from "../drawer/Drawer";
import { Inspector } from "../inspector/Inspector";
import { Stage } from "../stage/Stage";
import { SidePanel } from "../tree/SidePanel";
import { Boundary } from "../ui/Boundary";
import { KeysDialog } from "./KeysDialog";
import { listenToKeys } from "./shortcuts";
import { NameDialog } from "./NameDialog";
import { RoomsDialog } from "./RoomsDialog";
import { TopBar } from "./TopBar";

export function Workspace() {
  useEffect(listenToKeys, []);
  return (
    <div class="app">
      <a class="skip" href="#stage">
        Skip to the picture
      </a>
      <Boundary name="The top bar">
        <TopBar />
      </Boundary>
      {isTreeOpen.value && (
        <Boundary name="The scene list">
          <SidePanel />
        </Boundary>
      )}
      <Boundary name="The picture">
        <Stage />
      </Boundary>
      {isInspectorOpen.value && <Inspector />}
      <Drawer />
      <KeysDialog />
      <NameDialog />
      <RoomsDialog />
    </div>
  );
}
