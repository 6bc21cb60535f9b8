// What of the scene lies under the pointer, by the outlines that this page knows.
import type { Pixel, View } from "../../math/camera";
import { project } from "../../math/camera";
import { corners } from "../../math/bounds";
import { convexHull, isInside } from "../../math/hull";
import { boundsByObject } from "../../state/assets";
import { lights, objects } from "../../state/scene";
import { lampMarks, type LampMark, type Sheet } from "./outlines";

const LAMP_REACH_PX = 16;

/** Objects whose boxes cover a pixel of the picture, the smallest outline first. */
export function objectsAt(view: View, pixel: Pixel): string[] {
  const found = objects.value.flatMap((item) => {
    const bounds = boundsByObject.value.get(item.id);
    if (!bounds || !item.visible || item.frame !== "world") return [];
    const points = corners(item.pose, bounds).map((point) => project(view, point));
    if (points.some((point) => point === null)) return [];
    const hull = convexHull(points as Pixel[]);
    return isInside(hull, pixel) ? [{ id: item.id, area: area(hull) }] : [];
  });
  return found.sort((a, b) => a.area - b.area).map((each) => each.id);
}

function area(hull: readonly Pixel[]): number {
  return hull.reduce((sum, [x, y], index) => {
    const [nextX, nextY] = hull[(index + 1) % hull.length]!;
    return sum + (x * nextY - nextX * y) / 2;
  }, 0);
}

/** The mark of a lamp that is under a point of the sheet. */
export function lampAt(sheet: Pick<Sheet, "view" | "factor" | "width" | "height">, [x, y]: Pixel): LampMark | null {
  if (lights.value?.mode !== "manual") return null;
  return (
    lampMarks(sheet, lights.value.manual).find(({ at }) => Math.hypot(at[0] - x, at[1] - y) < LAMP_REACH_PX) ?? null
  );
}
