// How late the pictures are: from capture by the camera to the animation frame that shows them here.
import { computed, signal } from "@preact/signals";
import { milliseconds } from "../math/units";

export interface Shown {
  /** Seconds since the page was opened. */
  readonly at: number;
  /** Since the capture, ms. */
  readonly delay: number;
}

export interface DelayFigures {
  readonly median: number;
  readonly p95: number;
}

const KEPT_S = 60;
const WINDOW_S = 10;

/** The pictures of the last minute that were shown. */
export const shown = signal<readonly Shown[]>([]);
export const delay = computed(() => delayFigures(shown.value));

export const DELAY_TIP =
  "From the capture of a frame to its picture on this page: median and 95th percentile of the last 10 s. " +
  "Network time between the server and this page is not included.";

let drawn: { readonly age: number; readonly arrival: number } | null = null;

/**
 * Note a picture that was drawn: the next animation frame shows it, unless a newer one is drawn before. `age` is the time
 * from its capture to its sending, ms; `arrival` when it arrived here, ms since the page was opened.
 */
export function noteDrawn(age: number, arrival: number): void {
  if (drawn === null) requestAnimationFrame(noteShown);
  drawn = { age, arrival };
}

function noteShown(): void {
  if (drawn === null) return;
  const now = performance.now();
  const at = now / 1000;
  const recent = shown.value.filter((each) => each.at > at - KEPT_S);
  shown.value = [...recent, { at, delay: drawn.age + now - drawn.arrival }];
  drawn = null;
}

/** Median and 95th percentile (nearest rank) of the ten seconds before the newest picture; null without pictures. */
export function delayFigures(of: readonly Shown[]): DelayFigures | null {
  const last = of.at(-1);
  if (!last) return null;
  const sorted = of.filter((each) => each.at > last.at - WINDOW_S).map((each) => each.delay);
  sorted.sort((one, other) => one - other);
  const rank = (share: number): number => sorted[Math.ceil(share * sorted.length) - 1]!;
  return { median: rank(0.5), p95: rank(0.95) };
}

export function delayText(figures: DelayFigures | null): string {
  return figures ? `${milliseconds(figures.median)} (p95 ${milliseconds(figures.p95)})` : "–";
}
