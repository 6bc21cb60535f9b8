// Steps that values snap to while Shift is held.
import type { Vector } from "../api/types";

export const SNAP_M = 0.01;
export const SNAP_DEG = 15;
export const SNAP_SCALE = 0.1;

/** The nearest multiple of `step`, free of the digits that division leaves. */
export function snap(value: number, step: number): number {
  const decimals = Math.max(0, Math.ceil(-Math.log10(step)) + 2);
  return Number((Math.round(value / step) * step).toFixed(decimals));
}

export function snapVector(value: Vector, step: number): Vector {
  return [snap(value[0], step), snap(value[1], step), snap(value[2], step)];
}
