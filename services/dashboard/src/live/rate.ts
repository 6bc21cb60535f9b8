// How many pictures come a second, the one number that the page shows wherever it shows a rate.

const WINDOW_MS = 3000;
// Pictures that waited for the page come all at once; a rate of less than this would be theirs.
const LEAST_MS = 500;

/** How many bits a second come, over the same time. */
export class BitMeter {
  private arrivals: readonly { readonly bytes: number; readonly atMs: number }[] = [];

  note(bytes: number, nowMs: number): void {
    this.arrivals = [...this.arrivals.filter((each) => each.atMs > nowMs - WINDOW_MS), { bytes, atMs: nowMs }];
  }

  /** Thousands of bits a second up to now; null at the very beginning. What came first began the time and is not in it. */
  kilobits(nowMs: number): number | null {
    const [first, ...rest] = this.arrivals;
    if (!first || nowMs - first.atMs < LEAST_MS) return null;
    return (8 * rest.reduce((sum, each) => sum + each.bytes, 0)) / (nowMs - first.atMs);
  }
}

/** Counts pictures by the number that the service gives them, so that those this browser skipped count too. */
export class RateMeter {
  private arrivals: readonly { readonly number: number; readonly atMs: number }[] = [];

  note(number: number, nowMs: number): void {
    const before = this.arrivals.at(-1);
    const kept = before && before.number >= number ? [] : this.arrivals; // the service began anew
    const recent = kept.filter((each, index) => index === kept.length - 1 || each.atMs > nowMs - WINDOW_MS);
    this.arrivals = [...recent, { number, atMs: nowMs }];
  }

  /** Pictures a second up to now, so that it falls while none come; null before the second and at the very beginning. */
  rate(nowMs: number): number | null {
    const [first, last] = [this.arrivals[0], this.arrivals.at(-1)];
    if (!first || !last || first === last || nowMs - first.atMs < LEAST_MS) return null;
    return (1000 * (last.number - first.number)) / (nowMs - first.atMs);
  }
}
