// Steps that values snap to while Shift is held.
import type { Pose, Vector } from "../api/types";
import { isSteep } from "./bounds";

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

/** The pose at steps of x and y, moved along its surface; as it is on walls. */
export function stepped(pose: Pose, normal: Vector): Pose {
  const [x, y, z] = pose.translation_m;
  if (isSteep(normal)) return pose;
  const [dx, dy] = [snap(x, SNAP_M) - x, snap(y, SNAP_M) - y];
  const dz = -(normal[0] * dx + normal[1] * dy) / normal[2];
  return { ...pose, translation_m: [x + dx, y + dy, z + dz] };
}
