// Dragging the selection itself: over real surfaces, or over the level plane through it.
import type { PickAnswer, Pose, Vector } from "../api/types";
import { lookAt, NewestPick } from "../live/pick";
import { view } from "../live/picture";
import { footOf, isTurnedAlike, levelled, type Bounds } from "../math/bounds";
import { column, eyeOf, isInPicture, meetPlane, project, type Pixel, type View } from "../math/camera";
import { snap, SNAP_M, stepped } from "../math/snap";
import { add, cross, dot, length, normalized, scaled, subtract, UP } from "../math/vector";
import { boundsByObject } from "./assets";
import { handle, HandleDrag, type Handle } from "./handle";
import { track } from "./pending";
import { isTooSteep, restingOn } from "./placing";
import { standsOnSurfaces } from "./preferences";
import { footing, type Footing } from "./tools";

export interface Slide {
  /** `snaps`: to the steps of the grid. */
  readonly move: (pixel: Pixel, snaps: boolean) => void;
  readonly cancel: () => void;
  readonly end: () => void;
}

/** Whether what is selected stands on surfaces while it is dragged. */
export function slidesOnSurfaces(): boolean {
  return standsOnSurfaces.value && handle.value?.objectId != null;
}

/** Take what is selected at a pixel of the picture; null where there is nothing to take. */
export function beginSlide(pixel: Pixel): Slide | null {
  const held = handle.value;
  if (!held || !view.value) return null;
  if (held.objectId !== null && slidesOnSurfaces()) return slideOverSurfaces(held, held.objectId, pixel);
  const from = meetPlane(view.value, pixel, held.pose.translation_m, UP);
  return (
    from &&
    new LevelSlide(held, (seen, at) => {
      const to = meetPlane(seen, at, from, UP);
      return to && subtract(to, from);
    })
  );
}

/** Take what is selected by its sign at the picture's border; the picture itself does not show it. */
export function beginBorderSlide(pixel: Pixel): Slide | null {
  const held = handle.value;
  if (!held) return null;
  const from = held.pose.translation_m;
  return new LevelSlide(held, (seen, at) => levelWay(seen, from, [at[0] - pixel[0], at[1] - pixel[1]]));
}

/**
 * How far a point goes over the level plane, m, while the pointer goes some pixels: to the right, and up for away from
 * the viewer, by what a pixel spans at the point's distance. Holds for points behind the camera too.
 */
export function levelWay(seen: View, point: Vector, [dx, dy]: Pixel): Vector {
  const pixel_m = length(subtract(point, eyeOf(seen))) / seen.lens.fx;
  const [x, y] = column(seen.worldFromCamera, 0);
  const right = Math.hypot(x, y) > 1e-6 ? normalized([x, y, 0]) : ([1, 0, 0] as const);
  return add(scaled(right, dx * pixel_m), scaled(cross(UP, right), -dy * pixel_m));
}

let latest: SurfaceSlide | null = null;

function slideOverSurfaces(held: Handle, objectId: string, pixel: Pixel): Slide {
  latest?.leave();
  latest = new SurfaceSlide(held, objectId, pixel);
  return latest;
}

/** Keeps the height; `way` leads from where it was to where the pointer has it. */
class LevelSlide implements Slide {
  private readonly drag: HandleDrag;
  private readonly pose: Pose;

  constructor(
    held: Handle,
    private readonly way: (seen: View, pixel: Pixel) => Vector | null,
  ) {
    this.drag = new HandleDrag(held);
    this.pose = held.pose;
  }

  move(pixel: Pixel, snaps: boolean): void {
    const way = view.value && this.way(view.value, pixel);
    if (!way) return;
    const [x, y, z] = add(this.pose.translation_m, way);
    this.drag.move({ ...this.pose, translation_m: snaps ? [snap(x, SNAP_M), snap(y, SNAP_M), z] : [x, y, z] });
  }

  cancel(): void {
    this.drag.move(this.pose);
    this.end();
  }

  end(): void {
    void this.drag.end();
  }
}

// Measured depth is off by some millimetres at arm's length: what differs less is the same surface.
const SAME_M = 0.005;
// No depth camera sees farther; beyond, a plane is met where it only seems to go on.
const FARTHEST_M = 20;

/**
 * Stands on what the camera sees under the object. The foot follows the pointer at once, over the surface that was seen
 * last; that surface follows as fast as the render server tells it.
 */
export class SurfaceSlide implements Slide {
  private readonly drag: HandleDrag;
  private readonly bounds: Bounds | null;
  private readonly surface: NewestPick;
  private readonly grip: Pixel; // from the pointer to the foot, so that the object does not jump
  private plane: Footing;
  private foot: Pixel | null = null;
  private snaps = false;
  private isOver = false;

  constructor(
    private readonly held: Handle,
    objectId: string,
    pixel: Pixel,
  ) {
    this.drag = new HandleDrag(held);
    this.bounds = boundsByObject.value.get(objectId) ?? null;
    this.plane = { point: footOf(held.pose, this.bounds, UP), normal: UP };
    const foot = (view.value && project(view.value, this.plane.point)) ?? pixel;
    this.grip = [foot[0] - pixel[0], foot[1] - pixel[1]];
    this.surface = new NewestPick(
      (at) => lookAt(at, objectId),
      (found) => this.take(found),
    );
  }

  move([x, y]: Pixel, snaps: boolean): void {
    this.foot = [x + this.grip[0], y + this.grip[1]];
    this.snaps = snaps;
    this.place();
    if (view.value && isInPicture(view.value.lens, this.foot)) this.surface.ask(this.foot);
  }

  cancel(): void {
    this.leave();
    this.drag.move(this.held.pose);
    void this.drag.end();
  }

  /** The drag ends with the answer for its last place; undo waits for it. */
  end(): void {
    void track(this.surface.answered().then(() => this.finish()));
  }

  private async finish(): Promise<void> {
    if (this.isOver) return;
    this.leave();
    await this.drag.end();
  }

  /** Answers that are still to come change nothing any more. */
  leave(): void {
    if (!this.isOver) footing.value = null;
    this.isOver = true;
  }

  private take({ point_m, normal }: PickAnswer): void {
    if (this.isOver || !point_m) return;
    const seen: Footing = { point: point_m, normal: levelled(normal ?? UP) };
    if (isTooSteep(seen.normal)) return;
    const away = Math.abs(dot(subtract(seen.point, this.plane.point), this.plane.normal));
    if (away < SAME_M && isTurnedAlike(seen.normal, this.plane.normal)) return;
    this.plane = seen;
    this.place();
  }

  private place(): void {
    const point = this.foot && view.value && meetPlane(view.value, this.foot, this.plane.point, this.plane.normal);
    if (!point || !view.value || length(subtract(point, eyeOf(view.value))) > FARTHEST_M) return;
    const { normal } = this.plane;
    const pose = restingOn(this.held.pose, this.bounds, point, normal);
    const shown = this.snaps ? stepped(pose, normal) : pose;
    footing.value = { point: add(point, subtract(shown.translation_m, pose.translation_m)), normal };
    this.drag.move(shown);
  }
}
