// A run of small changes (a drag, a slider) that is shown at once, sent at a steady rate, and undone as one.
import { change, overlay } from "./scene";
import { track } from "./pending";
import { merged, type Patch, type Target } from "./targets";

// 15 changes a second: faster than any picture follows in software, half a video rate on a GPU.
export const SEND_INTERVAL_MS = 1000 / 15;

/** Sending is given by whoever tests it. */
export type Sender = (target: Target, patch: Patch, gesture: string) => Promise<number | null>;

export class Gesture {
  readonly id = randomId();
  private waiting: Patch | null = null;
  private shown: Patch = {};
  private sending: Promise<void> | null = null;
  private lastSent = -Infinity;
  private revision: number | null = null;

  constructor(
    private readonly target: Target,
    private readonly sender: Sender = sendChange,
  ) {}

  /** Show a change, and send it as soon as the rate allows; newer values of a key replace those not sent yet. */
  push(patch: Patch): void {
    this.waiting = merged(this.waiting ?? {}, patch);
    this.shown = merged(this.shown, patch);
    overlay(this, (document) => this.target.apply(document, this.shown));
    this.sending ??= track(this.run());
  }

  /** Send what is left; returns the scene's revision then, null where nothing was accepted. */
  async end(): Promise<number | null> {
    await this.sending;
    return this.revision;
  }

  private async run(): Promise<void> {
    while (this.waiting !== null) {
      const pause = this.lastSent + SEND_INTERVAL_MS - performance.now();
      if (pause > 0) await new Promise((resolve) => setTimeout(resolve, pause));
      const patch = this.waiting;
      this.waiting = null;
      this.lastSent = performance.now();
      this.revision = (await this.sender(this.target, patch, this.id)) ?? this.revision;
    }
    this.sending = null;
    this.shown = {};
    overlay(this, null);
  }
}

async function sendChange(target: Target, patch: Patch, gesture: string): Promise<number | null> {
  const answer = await change("PATCH", target.path, patch, { gesture });
  return answer?.revision ?? null;
}

/** Random letters; `crypto.randomUUID` is missing where a page came without TLS. */
export function randomId(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** One change by itself. */
export async function edit(target: Target, patch: Patch): Promise<number | null> {
  const gesture = new Gesture(target);
  gesture.push(patch);
  return gesture.end();
}
