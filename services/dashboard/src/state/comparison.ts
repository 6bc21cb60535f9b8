// Two pictures of one frame, side by side under a split.
import { signal } from "@preact/signals";

export interface Side {
  readonly label: string;
  readonly path: string;
}

export interface Comparison {
  readonly a: Side;
  readonly b: Side;
  readonly frameId: number;
}

export const comparison = signal<Comparison | null>(null);
