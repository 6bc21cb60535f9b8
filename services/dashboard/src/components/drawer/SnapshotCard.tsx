import { API } from "../../api/http";
import { role } from "../../api/session";
import type { Snapshot } from "../../api/types";
import { counted } from "../../math/units";
import { deleteSnapshot } from "../../state/takes";
import { save } from "../ui/download";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";
import { SecureImage } from "../ui/SecureImage";

const MOVING = ["before-after.gif", "before-after.mp4"];

export function SnapshotCard({ snapshot }: { readonly snapshot: Snapshot }) {
  const path = `${API}/snapshots/${snapshot.id}`;
  const poster = snapshot.files.includes("composite.png")
    ? "composite.png"
    : snapshot.files.find((file) => file.endsWith(".png"));
  const hasBoth = ["camera", "composite"].every((view) =>
    snapshot.pictures.some((picture) => picture.view === view && picture.file !== null),
  );
  const files = hasBoth ? [...snapshot.files, ...MOVING] : snapshot.files;
  const entries: MenuEntry[] = [
    ...files.map((file): MenuEntry => ({
      label: file,
      icon: "download",
      onClick: () => save(`${path}/${file}`, `frame-${snapshot.frame_id}-${file}`),
    })),
    {
      label: "Delete",
      icon: "trash",
      begins: true,
      disabled: role.value !== "control",
      onClick: () => deleteSnapshot(snapshot.id),
    },
  ];
  const taken = new Date(snapshot.taken).toLocaleString([], { dateStyle: "medium", timeStyle: "medium" });
  return (
    <article class="card take" aria-label={`Snapshot of frame ${snapshot.frame_id}`}>
      {poster && <SecureImage className="poster" path={`${path}/${poster}`} alt="" />}
      <div class="take-text">
        <h3>Frame {snapshot.frame_id}</h3>
        <p class="quiet small">{taken}</p>
        <Menu label={`Files of frame ${snapshot.frame_id}`} entries={entries} kind="plain">
          <Icon name="download" /> {counted(files.length, "file")}
        </Menu>
      </div>
    </article>
  );
}
