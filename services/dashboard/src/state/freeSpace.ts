// Where a new object has room: upright, on a real surface that the camera sees, beside the objects that are there.
import type { PickAnswer, Pose, Vector } from "../api/types";
import { corners, isSteep, restOn, type Bounds } from "../math/bounds";
import { eyeOf, isInPicture, meetPlane, project, type Pixel, type View } from "../math/camera";
import { length, subtract, UP } from "../math/vector";

/** What is at a pixel; a refusal ends the search, since other questions would wait as long. */
export type Look = (pixel: Pixel) => Promise<PickAnswer>;

/** What an object covers of the ground, around its upright axis. */
export interface Footprint {
  readonly center: Vector;
  readonly radius: number;
}

export interface Wanted {
  readonly view: View;
  /** The point that the place is to be near to. */
  readonly start: Vector;
  /** The pose to be put somewhere, and the box of its file. */
  readonly pose: Pose;
  readonly bounds: Bounds | null;
  readonly taken: readonly Footprint[];
}

export const GAP_M = 0.02;
const SMALLEST_RADIUS_M = 0.03;
const RINGS = 6;
// Eighths of a turn, in an order whose beginning looks in all directions already.
const TURNS = [0, 4, 2, 6, 1, 5, 3, 7];
// Each place is looked at by as many questions as the render server takes at once; more places would take too long.
const MOST_PLACES = 6;
const AROUND: readonly Vector[] = [
  [1, 0, 0],
  [-1, 0, 0],
  [0, 1, 0],
  [0, -1, 0],
];
// A step of the ground that an object may stand over; measured depth is off by some millimetres.
const STEP_M = 0.02;
const MARGIN = 0.06; // of the picture, that stays free at its edges
const FARTHEST_M = 5; // beyond, nobody would find what was added

export function footprintOf(pose: Pose, bounds: Bounds | null): Footprint {
  if (!bounds) return { center: pose.translation_m, radius: SMALLEST_RADIUS_M };
  const points = corners(pose, bounds);
  const edge = (axis: 0 | 1 | 2): readonly [number, number] => {
    const values = points.map((point) => point[axis]);
    return [Math.min(...values), Math.max(...values)];
  };
  const [[left, right], [near, far], [low]] = [edge(0), edge(1), edge(2)];
  return {
    center: [(left + right) / 2, (near + far) / 2, low],
    radius: Math.max(SMALLEST_RADIUS_M, Math.hypot(right - left, far - near) / 2),
  };
}

export function isFree(place: Vector, radius: number, taken: readonly Footprint[]): boolean {
  return taken.every(
    ({ center, radius: other }) => Math.hypot(place[0] - center[0], place[1] - center[1]) >= radius + other + GAP_M,
  );
}

/** Places on a level plane, the nearest to the wanted first, that are in the picture and clear of other objects. */
export function places(wanted: Wanted, radius: number): Vector[] {
  const { start } = wanted;
  const step = Math.max(radius, SMALLEST_RADIUS_M);
  const all: Vector[] = [start];
  for (let ring = 1; ring <= RINGS; ring++) {
    for (const turn of TURNS) {
      const angle = (2 * Math.PI * turn) / TURNS.length;
      all.push([start[0] + ring * step * Math.cos(angle), start[1] + ring * step * Math.sin(angle), start[2]]);
    }
  }
  return all.filter((place) => isFree(place, radius, wanted.taken) && isWellInPicture(wanted.view, place));
}

function isWellInPicture(view: View, place: Vector): boolean {
  const pixel = project(view, place);
  if (!pixel || length(subtract(place, eyeOf(view))) > FARTHEST_M) return false;
  const { width, height } = view.lens;
  const [x, y] = [pixel[0] / width, pixel[1] / height];
  return x > MARGIN && x < 1 - MARGIN && y > MARGIN && y < 1 - MARGIN;
}

/** The free place on a real, level surface that is nearest to a point; null where none was found. */
export async function freePlace(wanted: Wanted, look: Look): Promise<Vector | null> {
  const { radius } = footprintOf(restOn(wanted.pose, wanted.bounds, [0, 0, 0], UP), wanted.bounds);
  let second: Vector | null = null;
  for (const place of places(wanted, radius).slice(0, MOST_PLACES)) {
    const seen = await lookAround(wanted.view, place, radius, look);
    if (!seen || !isFree(seen.point, radius, wanted.taken)) continue;
    if (seen.isClear) return seen.point;
    second ??= seen.point;
  }
  return second;
}

/** A point at the height of the surface at a pixel, else on the board's plane. */
export async function startAt(view: View, pixel: Pixel, look: Look): Promise<Vector | null> {
  const found = standable(await look(pixel));
  return found ?? meetPlane(view, pixel, [0, 0, 0], UP);
}

interface Seen {
  readonly point: Vector;
  /** Nothing real stands in the way. */
  readonly isClear: boolean;
}

async function lookAround(view: View, place: Vector, radius: number, look: Look): Promise<Seen | null> {
  const around = AROUND.map(([x, y]): Vector => [place[0] + x * radius, place[1] + y * radius, place[2]]);
  const pixels = [place, ...around].map((point) => project(view, point));
  const [middle, ...others] = await Promise.all(
    pixels.map((pixel) => (pixel && isInPicture(view.lens, pixel) ? look(pixel) : Promise.resolve(undefined))),
  );
  const point = standable(middle);
  if (!point) return null;
  const isClear = others.every((each) => {
    const beside = standable(each);
    return beside !== null && Math.abs(beside[2] - point[2]) < STEP_M;
  });
  return { point, isClear };
}

/** The point that something can stand on: of a real surface that is not too steep. */
export function standable(found: PickAnswer | undefined): Vector | null {
  if (found?.kind !== "real" || !found.point_m || (found.normal && isSteep(found.normal))) return null;
  return found.point_m;
}

/** The place on the board's plane before a wall that was seen, with room for a radius between them. */
export function beforeWall([x, y]: Vector, normal: Vector | null, radius: number): Vector {
  const away = Math.hypot(normal?.[0] ?? 0, normal?.[1] ?? 0);
  if (!normal || away === 0) return [x, y, 0];
  return [x + (normal[0] / away) * radius, y + (normal[1] / away) * radius, 0];
}
