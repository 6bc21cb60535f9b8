// What the plots show: times and rate of the last frames.
import { signal } from "@preact/signals";
import type { LiveHeader } from "../api/types";

export interface Sample {
  /** Seconds since the page was opened. */
  readonly at: number;
  readonly rate: number | null;
  /** What the renderer took for the frame, ms. */
  readonly took: number;
  readonly passes: Readonly<Record<string, number>>;
  /** Names of the passes whose results this frame used again: their times are those of when they ran. */
  readonly reused: ReadonlySet<string>;
}

const KEPT_S = 60;
export const OTHERS = "others";

export const samples = signal<readonly Sample[]>([]);

export function note(header: LiveHeader, nowMs: number, rate: number | null): void {
  const at = nowMs / 1000;
  const passes = { ...header.reused_pass_times_ms, ...header.pass_times_ms };
  const reused = new Set(Object.keys(header.reused_pass_times_ms));
  const sample: Sample = { at, rate, took: header.render_ms, passes, reused };
  const kept = samples.value.filter((each) => each.at > at - KEPT_S);
  samples.value = [...kept, sample];
}

/** What the slowest frame of the last minute took the renderer, ms. */
export function slowestMs(): number {
  return samples.value.reduce((most, each) => Math.max(most, each.took), 0);
}

/** Passes of the newest sample, then those before it, the costliest first, then `OTHERS` where there are more. */
export function leadingPasses(of: readonly Sample[], most: number): string[] {
  const sums = new Map<string, number>();
  for (const sample of of) {
    for (const [name, time] of Object.entries(sample.passes)) sums.set(name, (sums.get(name) ?? 0) + time);
  }
  const isCurrent = (name: string): number => Number(name in (of.at(-1)?.passes ?? {}));
  const ranked = [...sums].sort(([a, time], [b, other]) => isCurrent(b) - isCurrent(a) || other - time);
  const names = ranked.map(([name]) => name);
  return names.length > most ? [...names.slice(0, most), OTHERS] : names;
}

/** Time of one entry of `leadingPasses` in a sample. */
export function timeOf(sample: Sample, name: string, named: readonly string[]): number {
  if (name !== OTHERS) return sample.passes[name] ?? 0;
  return Object.entries(sample.passes)
    .filter(([pass]) => !named.includes(pass))
    .reduce((sum, [, time]) => sum + time, 0);
}

/** Sums from the first series on, for areas that lie on each other: series x samples. */
export function stacked(of: readonly Sample[], names: readonly string[]): number[][] {
  const sums = of.map(() => 0);
  return names.map((name) =>
    of.map((sample, index) => (sums[index] = (sums[index] ?? 0) + timeOf(sample, name, names))),
  );
}
