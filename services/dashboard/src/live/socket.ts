// A WebSocket that comes back by itself, waiting longer after each failure, and is made anew after long silence:
// pages are not told of a connection that a sleeping laptop or a router has lost.
import { signal, type Signal } from "@preact/signals";
import { socketAddress } from "../api/tickets";

export type Connection = "connecting" | "open" | "waiting" | "closed";

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 10_000;
export const LONGEST_SILENCE_MS = 60_000;

export class ReconnectingSocket {
  readonly state: Signal<Connection> = signal("closed");
  private socket: WebSocket | null = null;
  private failures = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private silence: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly path: string,
    private readonly onMessage: (event: MessageEvent<unknown>) => void,
  ) {}

  start(): void {
    if (this.state.value === "closed") void this.connect();
  }

  stop(): void {
    clearTimeout(this.timer);
    clearTimeout(this.silence);
    this.state.value = "closed";
    this.socket?.close();
    this.socket = null;
  }

  /** Try at once instead of waiting on. */
  retry(): void {
    if (this.state.value !== "waiting") return;
    clearTimeout(this.timer);
    void this.connect();
  }

  send(text: string): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(text);
  }

  private async connect(): Promise<void> {
    this.state.value = "connecting";
    try {
      const address = await socketAddress(this.path);
      if (this.isStopped()) return;
      this.open(new WebSocket(address));
    } catch {
      if (!this.isStopped()) this.wait(); // no ticket: the service is away
    }
  }

  private isStopped(): boolean {
    return this.state.value === "closed";
  }

  private open(socket: WebSocket): void {
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.state.value = "open";
      this.expectMessage();
    };
    socket.onmessage = (event: MessageEvent<unknown>) => {
      this.failures = 0;
      if (this.socket === socket) this.expectMessage();
      this.onMessage(event);
    };
    socket.onclose = () => {
      if (this.socket === socket && !this.isStopped()) this.wait();
    };
  }

  private expectMessage(): void {
    clearTimeout(this.silence);
    this.silence = setTimeout(() => {
      const lost = this.socket;
      this.socket = null; // its end, whenever it comes, is no news
      lost?.close();
      void this.connect();
    }, LONGEST_SILENCE_MS);
  }

  private wait(): void {
    clearTimeout(this.silence);
    this.state.value = "waiting";
    this.timer = setTimeout(() => void this.connect(), backoff(this.failures));
    this.failures += 1;
  }
}

/** Waiting time after so many failures in a row, milliseconds. */
export function backoff(failures: number): number {
  return Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** failures);
}
