// Addresses that cannot carry a header (WebSocket, <img>, download) take a one-use ticket where a token is needed.
import { API, request } from "./http";
import { token } from "./session";
import type { Ticket } from "./types";

/** The address with a fresh ticket, or as it is where no token is needed. */
export async function withTicket(path: string): Promise<string> {
  if (token.value === null) return path;
  const { ticket } = await request<Ticket>("POST", `${API}/tickets`);
  return `${path}${path.includes("?") ? "&" : "?"}ticket=${encodeURIComponent(ticket)}`;
}

export async function socketAddress(path: string): Promise<string> {
  const address = new URL(await withTicket(path), document.baseURI);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  return address.href;
}
