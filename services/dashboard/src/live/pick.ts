// What the live picture shows at a pixel: asked once, or again and again while something is dragged over it.
import { API, ProblemError, request } from "../api/http";
import type { PickAnswer } from "../api/types";
import type { Pixel } from "../math/camera";
import { frame } from "./picture";

// Ten a second: more would take the render server's time from the pictures.
export const PICK_INTERVAL_MS = 100;

/** What is at a pixel, seen through an object where one is named; throws the service's refusal. */
export function lookAt([x, y]: Pixel, ignore?: string): Promise<PickAnswer> {
  const camera = frame.value?.node ?? null; // whose picture is under the pointer
  const body = { x: Math.max(0, x), y: Math.max(0, y), camera, ...(ignore === undefined ? {} : { ignore }) };
  return request<PickAnswer>("POST", `${API}/live/pick`, { body });
}

/** Asks for the newest pixel only: one question is on its way, and those in between are left out. */
export class NewestPick {
  private wanted: Pixel | null = null;
  private asking: Promise<void> | null = null;
  private lastAsked = -Infinity;

  constructor(
    private readonly look: (pixel: Pixel) => Promise<PickAnswer>,
    private readonly onFound: (found: PickAnswer) => void,
  ) {}

  ask(pixel: Pixel): void {
    this.wanted = pixel;
    this.asking ??= this.run();
  }

  /** When the newest pixel has been answered. */
  async answered(): Promise<void> {
    await this.asking;
  }

  private async run(): Promise<void> {
    while (this.wanted !== null) {
      const pause = this.lastAsked + PICK_INTERVAL_MS - performance.now();
      if (pause > 0) await new Promise((resolve) => setTimeout(resolve, pause));
      const pixel = this.wanted;
      this.wanted = null;
      this.lastAsked = performance.now();
      await this.askOnce(pixel);
    }
    this.asking = null;
  }

  private async askOnce(pixel: Pixel): Promise<void> {
    try {
      this.onFound(await this.look(pixel));
    } catch (fault) {
      if (!(fault instanceof ProblemError)) throw fault; // a busy render server: what is dragged slides on without
    }
  }
}
