import { role } from "../../api/session";
import { isTakingSnapshot, takeBeforeAfter } from "../../state/takes";
import { announce } from "../../state/toasts";
import { download } from "../ui/download";
import { IconButton } from "../ui/IconButton";

/** Saves the frame that is shown, before and after, as a moving picture to share. */
export function ShareButton() {
  const share = async (): Promise<void> => {
    const made = await takeBeforeAfter();
    if (!made) return;
    await download(made.path, made.name);
    announce(`${made.name} was saved to your downloads.`);
  };
  const isDisabled = role.value !== "control" || isTakingSnapshot.value;
  return <IconButton icon="share" label="Save before and after as GIF" onClick={share} disabled={isDisabled} />;
}
