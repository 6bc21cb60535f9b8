// Where an object is put: at a pixel, where the picture has room, or beside another.
import { lookAt } from "../live/pick";
import type { PickAnswer, Pose, SceneObject, Vector } from "../api/types";
import { footOf, isSteep, restOn, standOn, type Bounds } from "../math/bounds";
import { meetPlane, type Pixel } from "../math/camera";
import { add, UP } from "../math/vector";
import { pictureSize, view } from "../live/picture";
import { boundsByObject } from "./assets";
import { beforeWall, footprintOf, freePlace, GAP_M, standable, startAt, type Footprint } from "./freeSpace";
import { leansWithSurfaces } from "./preferences";
import { objects } from "./scene";
import { attempt, toast } from "./toasts";

export async function pick(pixel: Pixel): Promise<PickAnswer | undefined> {
  return attempt(() => lookAt(pixel));
}

/** Where something new stands at a pixel: on the surface seen there, or on what is behind a virtual object. */
export async function pointAt(pixel: Pixel, radius: number): Promise<Vector> {
  const first = await pick(pixel);
  const found = first?.kind === "object" && first.object ? await attempt(() => lookAt(pixel, first.object!)) : first;
  const point = standable(found);
  if (point) return point;
  toast("There is no level surface there, so the object was placed on the plane of the board.");
  return found?.point_m ? beforeWall(found.point_m, found.normal, radius) : onBoard(pixel);
}

function onBoard(pixel: Pixel): Vector {
  return (view.value && meetPlane(view.value, pixel, [0, 0, 0], UP)) ?? [0, 0, 0];
}

/** The free place nearest to the picture's middle; a search that the service refused is told and ends. */
export async function roomInMiddle(pose: Pose, bounds: Bounds | null): Promise<Vector> {
  const seen = view.value;
  if (!seen) return [0, 0, 0];
  const found = await attempt(async () => {
    const start = await startAt(seen, centre(), lookAt);
    return start && (await roomNear(start, pose, bounds));
  });
  if (found) return found;
  tellElsewhere(found, "the object was placed in the middle of the picture");
  return onBoard(centre());
}

/** The free place nearest to an object, for its copy. */
export async function roomBeside({ id, pose, frame }: SceneObject): Promise<Vector> {
  const bounds = boundsByObject.value.get(id) ?? null;
  const foot = footOf(pose, bounds, UP);
  const found = frame === "world" ? await attempt(() => roomNear(foot, pose, bounds)) : null;
  if (found) return found;
  tellElsewhere(found, "the copy was placed beside the original at the same height");
  return add(foot, [2 * footprintOf(pose, bounds).radius + GAP_M, 0, 0]);
}

/** Tell where something was put without free space: none is there (null), or the search was refused. */
function tellElsewhere(found: null | undefined, where: string): void {
  const why = found === null ? "There is no free space" : "Free space was not found";
  toast(`${why}, so ${where}. Drag it where you want it.`);
}

async function roomNear(start: Vector, pose: Pose, bounds: Bounds | null): Promise<Vector | null> {
  return view.value && freePlace({ view: view.value, start, pose, bounds, taken: footprints() }, lookAt);
}

function footprints(): Footprint[] {
  return objects.value.flatMap((item) =>
    item.frame === "world" ? footprintOf(item.pose, boundsByObject.value.get(item.id) ?? null) : [],
  );
}

function centre(): Pixel {
  const { width, height } = pictureSize.value ?? { width: 0, height: 0 };
  return [(width - 1) / 2, (height - 1) / 2];
}

/** Whether nothing stands on such a surface, as on walls and edges; what leans does. */
export function isTooSteep(normal: Vector): boolean {
  return !leansWithSurfaces.value && isSteep(normal);
}

/** The pose on a surface, leaning with it where people want that. */
export function restingOn(pose: Pose, bounds: Bounds | null, point: Vector, normal: Vector): Pose {
  if (leansWithSurfaces.value) return standOn(pose, bounds, point, normal);
  return restOn(pose, bounds, point, UP); // along a measured normal it would float by its error
}
