import { useEffect } from "preact/hooks";
import { isInspectorOpen, isTreeOpen } from "../../state/preferences";
import { Drawer } from "../drawer/Drawer";
import { Inspector } from "../inspector/Inspector";
import { Stage } from "../stage/Stage";
import { SidePanel } from "../tree/SidePanel";
import { KeysDialog } from "./KeysDialog";
import { listenToKeys } from "./shortcuts";
import { TopBar } from "./TopBar";

export function Workspace() {
  useEffect(listenToKeys, []);
  return (
    <div class="app">
      <a class="skip" href="#stage">
        To the picture
      </a>
      <TopBar />
      {isTreeOpen.value && <SidePanel />}
      <Stage />
      {isInspectorOpen.value && <Inspector />}
      <Drawer />
      <KeysDialog />
    </div>
  );
}
