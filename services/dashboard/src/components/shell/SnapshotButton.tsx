import { role } from "../../api/session";
import { openDrawer } from "../../state/preferences";
import { isTakingSnapshot, takeSnapshot } from "../../state/takes";
import { IconButton } from "../ui/IconButton";

/** Keeps the frame that is shown, in every view. */
export function SnapshotButton() {
  const take = async (): Promise<void> => {
    if (await takeSnapshot(null, false)) openDrawer("snapshots");
  };
  const isDisabled = role.value !== "control" || isTakingSnapshot.value;
  return <IconButton icon="camera" label="Take a snapshot" onClick={take} disabled={isDisabled} />;
}
