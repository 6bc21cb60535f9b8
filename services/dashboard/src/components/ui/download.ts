import { withTicket } from "../../api/tickets";
import { attempt } from "../../state/toasts";

/** Have the browser keep a file of the service under a name. */
export async function download(path: string, name: string): Promise<void> {
  const address = await attempt(() => withTicket(path));
  if (address === undefined) return;
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
}
