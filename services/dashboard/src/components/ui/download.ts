import { requestBytes } from "../../api/http";
import { withTicket } from "../../api/tickets";
import { attempt } from "../../state/toasts";

const KEPT_MS = 60_000; // until the browser has surely begun to save it

/** Have the browser keep a file of the service under a name. */
export async function download(path: string, name: string): Promise<void> {
  const address = await attempt(() => withTicket(path));
  if (address !== undefined) follow(address, name);
}

/** The same for what the service makes when it is asked, and may refuse; a refusal is told. */
export async function save(path: string, name: string): Promise<void> {
  const content = await attempt(() => requestBytes(path));
  if (content === undefined) return;
  const address = URL.createObjectURL(new Blob([content]));
  follow(address, name);
  setTimeout(() => URL.revokeObjectURL(address), KEPT_MS);
}

function follow(address: string, name: string): void {
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
}
