import { AssetList } from "./AssetList";
import { SceneTree } from "./SceneTree";

/** What is in the scene, and the files to make more of. */
export function SidePanel() {
  return (
    <nav class="side left" aria-label="Scene and assets">
      <SceneTree />
      <AssetList />
    </nav>
  );
}
