// A WebSocket that comes back by itself, waiting longer after each failure.
import { signal, type Signal } from "@preact/signals";
import { socketAddress } from "../api/tickets";

export type Connection = "connecting" | "open" | "waiting" | "closed";

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 10_000;

export class ReconnectingSocket {
  readonly state: Signal<Connection> = signal("closed");
  private socket: WebSocket | null = null;
  private failures = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly path: string,
    private readonly onMessage: (event: MessageEvent<unknown>) => void,
  ) {}

  start(): void {
    if (this.state.value === "closed") void this.connect();
  }

  stop(): void {
    clearTimeout(this.timer);
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
    socket.onopen = () => (this.state.value = "open");
    socket.onmessage = (event: MessageEvent<unknown>) => {
      this.failures = 0;
      this.onMessage(event);
    };
    socket.onclose = () => {
      if (this.socket === socket && !this.isStopped()) this.wait();
    };
  }

  private wait(): void {
    this.state.value = "waiting";
    this.timer = setTimeout(() => void this.connect(), backoff(this.failures));
    this.failures += 1;
  }
}

/** Waiting time after so many failures in a row, milliseconds. */
export function backoff(failures: number): number {
  return Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** failures);
}
