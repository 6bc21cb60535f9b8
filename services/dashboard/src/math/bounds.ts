// Boxes of assets, and where they lie when an object stands somewhere.
import type { AssetAnswer, Pose, SceneObject, Vector } from "../api/types";
import { multiply, rotate, turnBetween } from "./rotation";
import { UP, add, dot, scaled, subtract } from "./vector";

/** Corners of a box, metres, in the object's own frame (z up). */
export interface Bounds {
  readonly minimum: Vector;
  readonly maximum: Vector;
}

/** Edges of a box as pairs of corners; bit 0, 1, 2 of a corner's number = at the maximum of x, y, z. */
export const EDGES: readonly (readonly [number, number])[] = [
  [0, 1],
  [2, 3],
  [4, 5],
  [6, 7],
  [0, 2],
  [1, 3],
  [4, 6],
  [5, 7],
  [0, 4],
  [1, 5],
  [2, 6],
  [3, 7],
];

// Normals of measured depth are off by a few degrees: what leans less than this is meant to be level.
const LEVEL_COSINE = Math.cos((5 * Math.PI) / 180);
const SMALLEST_M = 0.01;
const LARGEST_M = 1;
const SENSIBLE_M = 0.2;

/** Box of an asset with its up axis turned to z; null where it is no mesh. */
export function boundsOf(asset: AssetAnswer, upAxis: "y" | "z" | null | undefined): Bounds | null {
  const minimum = asVector(asset.facts.minimum);
  const maximum = asVector(asset.facts.maximum);
  if (minimum === null || maximum === null) return null;
  if ((upAxis ?? (asset.format === "glb" ? "y" : "z")) === "z") return { minimum, maximum };
  // +90 degrees about x: (x, y, z) becomes (x, -z, y)
  return {
    minimum: [minimum[0], -maximum[2], minimum[1]],
    maximum: [maximum[0], -minimum[2], maximum[1]],
  };
}

function asVector(value: unknown): Vector | null {
  if (!Array.isArray(value) || value.length !== 3 || !value.every((item) => typeof item === "number")) return null;
  return value as unknown as Vector;
}

export function boundsOfObject(item: SceneObject, assets: readonly AssetAnswer[]): Bounds | null {
  const asset = assets.find((each) => each.asset === item.asset);
  return asset ? boundsOf(asset, item.up_axis) : null;
}

export function size(bounds: Bounds): Vector {
  return subtract(bounds.maximum, bounds.minimum);
}

export function longestEdge(bounds: Bounds): number {
  return Math.max(...size(bounds));
}

/** A factor that makes an asset handy where it is larger than 1 m or smaller than 1 cm: 1 or a power of ten. */
export function sensibleScale(bounds: Bounds): number {
  const edge = longestEdge(bounds);
  if (edge <= 0 || (edge >= SMALLEST_M && edge <= LARGEST_M)) return 1;
  return 10 ** Math.round(Math.log10(SENSIBLE_M / edge));
}

export function transform(pose: Pose, point: Vector): Vector {
  return add(rotate(pose.rotation_wxyz, scaled(point, pose.scale)), pose.translation_m);
}

/** The eight corners of an object's box, in the frame that its pose is in. */
export function corners(pose: Pose, bounds: Bounds): Vector[] {
  return Array.from({ length: 8 }, (_, index) => {
    const pick = (axis: 0 | 1 | 2): number => ((index >> axis) & 1 ? bounds.maximum : bounds.minimum)[axis];
    return transform(pose, [pick(0), pick(1), pick(2)]);
  });
}

export function levelled(normal: Vector): Vector {
  return dot(normal, UP) > LEVEL_COSINE ? UP : normal;
}

/** Whether two surfaces are turned alike, as far as measured normals tell. */
export function isTurnedAlike(normal: Vector, other: Vector): boolean {
  return dot(normal, other) > LEVEL_COSINE;
}

/** Whether a surface is steeper than 45 degrees, as walls and the undersides of things are. */
export function isSteep(normal: Vector): boolean {
  return normal[2] < Math.SQRT1_2;
}

/** Where an object touches a surface that it rests on: below the middle of its box, against the normal. */
export function footOf(pose: Pose, bounds: Bounds | null, normal: Vector): Vector {
  if (!bounds) return pose.translation_m;
  const middle = transform(pose, scaled(add(bounds.minimum, bounds.maximum), 0.5));
  const depth = Math.min(...corners(pose, bounds).map((corner) => dot(subtract(corner, middle), normal)));
  return add(middle, scaled(normal, depth));
}

/** The pose that rests an object on a point of a surface, turned as it is. */
export function restOn(pose: Pose, bounds: Bounds | null, point: Vector, normal: Vector): Pose {
  const way = subtract(point, footOf(pose, bounds, normal));
  return { ...pose, translation_m: add(pose.translation_m, way) };
}

/** The pose that rests an object on a point of a surface, its up along the normal. */
export function standOn(pose: Pose, bounds: Bounds | null, point: Vector, normal: Vector): Pose {
  const up = levelled(normal);
  const turn = turnBetween(rotate(pose.rotation_wxyz, UP), up);
  return restOn({ ...pose, rotation_wxyz: multiply(turn, pose.rotation_wxyz) }, bounds, point, up);
}
