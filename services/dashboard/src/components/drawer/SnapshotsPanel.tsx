import { useSignal } from "@preact/signals";
import { role } from "../../api/session";
import { isTakingSnapshot, snapshots, takeSnapshot } from "../../state/takes";
import { isRead } from "../../state/events";
import { Skeleton } from "../ui/Skeleton";
import { Button } from "../ui/Button";
import { Empty } from "../ui/Empty";
import { Switch } from "../ui/Switch";
import { SnapshotCard } from "./SnapshotCard";

export function SnapshotsPanel() {
  const withExr = useSignal(false);
  const isBusy = isTakingSnapshot.value;
  return (
    <div class="cards">
      <div class="card action-card">
        <Button
          icon="camera"
          kind="primary"
          disabled={role.value !== "control" || isBusy}
          onClick={() => takeSnapshot(null, withExr.value)}
        >
          {isBusy ? "Rendering…" : "Take a snapshot"}
        </Button>
        <Switch
          label="Also save linear EXR"
          checked={withExr.value}
          onChange={(on) => (withExr.value = on)}
          disabled={role.value !== "control"}
        />
        <p class="quiet small">Saves one frame in every view, as PNG.</p>
      </div>
      {!isRead.value && <Skeleton />}
      {isRead.value && snapshots.value.length === 0 && (
        <Empty icon="camera" title="No snapshots yet">
          <p>Snapshots are kept on the server until you delete them.</p>
        </Empty>
      )}
      {snapshots.value.map((each) => (
        <SnapshotCard key={each.id} snapshot={each} />
      ))}
    </div>
  );
}
