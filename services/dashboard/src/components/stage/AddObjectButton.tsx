import { useRef } from "preact/hooks";
import { role } from "../../api/session";
import { addObject } from "../../state/actions";
import { assetName, assets, upload } from "../../state/assets";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";

export const MESH_TYPES = ".glb,.gltf,.zip,.obj,.ply,.stl";

/** Adds an object where the picture has room: of an asset that is there, or of a file. */
export function AddObjectButton() {
  const file = useRef<HTMLInputElement>(null);
  const meshes = assets.value.filter((each) => each.kind === "mesh");
  const entries: MenuEntry[] = [
    { label: "From a file…", icon: "upload", onClick: () => file.current?.click() },
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
