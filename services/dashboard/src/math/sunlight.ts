// A distant light from a shadow: its way leads from what throws the shadow to the shadow's tip.
import type { Vector } from "../api/types";
import { add, dot, length, normalized, scaled, subtract } from "./vector";

/** Albedo that is assumed of the surface on which the shadow lies; most rooms' surfaces have 0.3 to 0.7. */
export const ASSUMED_ALBEDO = 0.5;

/** How far from the tip light and shadow are compared, m: beyond the blur of measured depth and of soft shadows. */
const BESIDE_TIP_M = 0.025;
const LEAST_LENGTH_M = 0.01;
/** A shadow less dark than this says nothing of the light. */
const LEAST_CONTRAST = 1.15;

/** The way the light travels; null where both points are one, or the light would come from behind the surface. */
export function directionFrom(tip: Vector, thrower: Vector, normal: Vector): Vector | null {
  const way = subtract(tip, thrower);
  if (length(way) < LEAST_LENGTH_M) return null;
  const direction = normalized(way);
  return dot(direction, normal) < -0.02 ? direction : null;
}

/** Points of the surface beyond the tip, in the light, and before it, in the shadow. */
export function besideTip(tip: Vector, normal: Vector, direction: Vector): readonly [lit: Vector, dark: Vector] {
  const along = subtract(direction, scaled(normal, dot(direction, normal)));
  const step = scaled(normalized(along), BESIDE_TIP_M);
  return [add(tip, step), subtract(tip, step)];
}

/**
 * Irradiance across the beam that makes the difference of two radiances on a diffuse surface, E = pi (L - L') / (albedo
 * cos); null where the shadow is too weak to tell.
 */
export function irradianceFrom(lit: number, dark: number, normal: Vector, direction: Vector): number | null {
  const cosine = -dot(normal, direction);
  if (!(dark > 0) || lit < LEAST_CONTRAST * dark || cosine <= 0) return null;
  return (Math.PI * (lit - dark)) / (ASSUMED_ALBEDO * cosine);
}
