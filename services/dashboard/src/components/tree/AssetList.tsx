import { useRef } from "preact/hooks";
import { useSignal } from "@preact/signals";
import { role } from "../../api/session";
import { assets, upload } from "../../state/assets";
import { isRead } from "../../state/events";
import { Skeleton } from "../ui/Skeleton";
import { IconButton } from "../ui/IconButton";
import { MESH_TYPES } from "../stage/AddObjectButton";
import { AssetCard } from "./AssetCard";

const TYPES = `${MESH_TYPES},.hdr,.exr,.dlmat`;

/** Uploaded files; dropping one here only uploads it. */
export function AssetList() {
  const file = useRef<HTMLInputElement>(null);
  const isDropping = useSignal(false);
  const mayChange = role.value === "control";
  const take = (files: FileList | null | undefined): void => {
    for (const each of files ?? []) void upload(each);
  };
  return (
    <section
      class={`assets ${isDropping.value ? "dropping" : ""}`}
      aria-label="Assets"
      onDragOver={(event) => {
        if (!event.dataTransfer?.types.includes("Files") || !mayChange) return;
        event.preventDefault();
        isDropping.value = true;
      }}
      onDragLeave={() => (isDropping.value = false)}
      onDrop={(event) => {
        event.preventDefault();
        isDropping.value = false;
        if (mayChange) take(event.dataTransfer?.files);
      }}
    >
      <header class="spread">
        <h2>Assets</h2>
        <IconButton icon="upload" label="Upload files" disabled={!mayChange} onClick={() => file.current?.click()} />
      </header>
      <input
        ref={file}
        type="file"
        multiple
        hidden
        accept={TYPES}
        aria-label="Files to upload"
        onChange={(event) => {
          take(event.currentTarget.files);
          event.currentTarget.value = "";
        }}
      />
      <ul class="asset-grid">
        {assets.value.map((asset) => (
          <AssetCard key={asset.asset} asset={asset} mayChange={mayChange} />
        ))}
      </ul>
      {!isRead.value && <Skeleton />}
      {isRead.value && assets.value.length === 0 && (
        <p class="tree-empty">{mayChange ? "Drop GLB, OBJ, PLY, STL, HDR, EXR or DLMAT files here." : "None yet."}</p>
      )}
    </section>
  );
}
