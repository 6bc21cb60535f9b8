import { useRef } from "preact/hooks";
import { role } from "../../api/session";
import type { ShelfItem } from "../../api/types";
import { addObject } from "../../state/actions";
import { assetName, assets, shelf, takeFromShelf, upload } from "../../state/assets";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";

export const MESH_TYPES = ".glb,.gltf,.zip,.obj,.ply,.stl";

/** Adds an object where the picture has room: of a file, a simple one of the service's, or an asset that is there. */
export function AddObjectButton() {
  const file = useRef<HTMLInputElement>(null);
  const ofShelf = new Set(shelf.value.map((item) => item.file_name));
  const meshes = assets.value.filter((each) => each.kind === "mesh" && !ofShelf.has(assetName(each)));
  const entries: MenuEntry[] = [
    { label: "From a file…", icon: "upload", onClick: () => file.current?.click() },
    ...shelf.value.map((item, index): MenuEntry => ({
      label: item.label,
      icon: "box",
      begins: index === 0,
      onClick: () => void addFromShelf(item),
    })),
    ...meshes.map((asset, index): MenuEntry => ({
      label: assetName(asset),
      icon: "box",
      begins: index === 0,
      onClick: () => addObject(asset),
    })),
  ];
  const onFile = async (input: HTMLInputElement): Promise<void> => {
    const chosen = input.files?.[0];
    input.value = "";
    if (!chosen) return;
    const asset = await upload(chosen);
    if (asset?.kind === "mesh") await addObject(asset, null, chosen.name);
  };
  return (
    <>
      <Menu label="Add object" entries={entries} disabled={role.value !== "control"}>
        <Icon name="add" />
        <span class="wide-only">Add object</span>
      </Menu>
      <input ref={file} type="file" hidden accept={MESH_TYPES} onChange={(event) => void onFile(event.currentTarget)} />
    </>
  );
}

async function addFromShelf(item: ShelfItem): Promise<void> {
  const asset = await takeFromShelf(item);
  if (asset) await addObject(asset, null, item.file_name, item.clip);
}
