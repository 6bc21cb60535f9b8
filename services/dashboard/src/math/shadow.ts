// A lamp that follows its shadow: what throws a shadow stays, and the lamp turns around it (Poulin and Fournier, "Lights
// from highlights and shadows", 1992).
import type { ManualLight, Pose, Vector } from "../api/types";
import type { Bounds } from "./bounds";
import { conjugate, rotate, turnBetween } from "./rotation";
import { add, cross, dot, length, normalized, scaled, subtract } from "./vector";

/** A light that throws shadows. */
export type ShadowLight = Exclude<ManualLight, { type: "ambient" }>;

/** Stands for the infinite way to a distant light, m. */
const FAR_M = 100;

export function throwsShadows(light: ManualLight): light is ShadowLight {
  return light.type !== "ambient";
}

/** A point from which a light shines on another point. */
export function sourceOf(light: ShadowLight, point: Vector): Vector {
  return "position_m" in light ? light.position_m : subtract(point, scaled(normalized(light.direction), FAR_M));
}

/** What a light gives to a surface that faces it at a point; the units of all kinds are alike. */
export function strengthAt(light: ShadowLight, point: Vector): number {
  if (light.type === "directional") return light.irradiance;
  const offset = subtract(light.position_m, point);
  const distance2 = Math.max(dot(offset, offset), 1e-6);
  if (light.type === "rectangle") return (light.radiance * length(cross(light.axis_u_m, light.axis_v_m))) / distance2;
  return light.intensity / distance2;
}

/** The middle of what a box cuts out of the way between two points; null where the way passes by. */
export function insideBox(pose: Pose, bounds: Bounds, from: Vector, to: Vector): Vector | null {
  const turn = conjugate(pose.rotation_wxyz);
  const local = (point: Vector): Vector => scaled(rotate(turn, subtract(point, pose.translation_m)), 1 / pose.scale);
  const start = local(from);
  const way = subtract(local(to), start);
  let [enters, leaves] = [0, 1];
  for (const axis of [0, 1, 2] as const) {
    const [low, high] = [bounds.minimum[axis] - start[axis], bounds.maximum[axis] - start[axis]];
    if (way[axis] === 0 && (low > 0 || high < 0)) return null;
    if (way[axis] === 0) continue;
    const [one, other] = [low / way[axis], high / way[axis]];
    enters = Math.max(enters, Math.min(one, other));
    leaves = Math.min(leaves, Math.max(one, other));
  }
  return enters < leaves ? add(from, scaled(subtract(to, from), (enters + leaves) / 2)) : null;
}

/** The light turned around what throws a shadow, so that the shadow falls on a point. */
export function withShadowAt(light: ShadowLight, thrower: Vector, point: Vector): Partial<ManualLight> {
  const away = normalized(subtract(thrower, point));
  if (light.type === "directional") return { direction: rounded(scaled(away, -1)) };
  const arm = subtract(light.position_m, thrower);
  const position_m = rounded(add(thrower, scaled(away, length(arm))));
  const turn = turnBetween(normalized(arm), away);
  const turned = (direction: Vector): Vector => rounded(rotate(turn, direction));
  if (light.type === "spot") return { position_m, direction: turned(light.direction) };
  if (light.type === "rectangle")
    return { position_m, axis_u_m: turned(light.axis_u_m), axis_v_m: turned(light.axis_v_m) };
  return { position_m };
}

/** Without the digits that mean nothing: a hundredth of a millimetre. */
function rounded(vector: Vector): Vector {
  const round = (value: number): number => Number(value.toFixed(5));
  return [round(vector[0]), round(vector[1]), round(vector[2])];
}
