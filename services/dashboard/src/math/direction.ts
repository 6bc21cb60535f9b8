// The way light travels, as where it comes from: bearing and height in degrees.
import type { Vector } from "../api/types";
import { length } from "./vector";

const DEGREE = Math.PI / 180;
// At 90 degrees every bearing is the same direction, and turning it would do nothing; this keeps it.
const STEEPEST = 89.99;

export function anglesFromDirection(direction: Vector): readonly [bearing: number, height: number] {
  const [x, y, z] = direction;
  const sine = Math.max(-1, Math.min(1, -z / (length(direction) || 1)));
  return [tidy(Math.atan2(-y, -x) / DEGREE), tidy(Math.asin(sine) / DEGREE)];
}

export function directionFromAngles(bearing: number, height: number): Vector {
  const flat = Math.cos(Math.max(-STEEPEST, Math.min(STEEPEST, height)) * DEGREE);
  const steep = Math.sin(Math.max(-STEEPEST, Math.min(STEEPEST, height)) * DEGREE);
  return [-flat * Math.cos(bearing * DEGREE), -flat * Math.sin(bearing * DEGREE), -steep];
}

function tidy(degrees: number): number {
  return Number(degrees.toFixed(1)) + 0;
}
