// What is drawn over the picture besides the gizmo: boxes of objects, and lamps.
import type { ManualLight, Pose, Vector } from "../../api/types";
import { corners, EDGES, type Bounds } from "../../math/bounds";
import { cameraFromWorld, project, type Pixel, type View } from "../../math/camera";
import { hexFromLinear } from "../../math/color";
import { add, cross, normalized, scaled } from "../../math/vector";
import type { Footing } from "../../state/tools";

export interface Sheet {
  readonly context: CanvasRenderingContext2D;
  readonly view: View;
  /** CSS pixels of one pixel of the picture. */
  readonly factor: number;
  readonly width: number;
  readonly height: number;
}

export interface BoxStyle {
  readonly color: string;
  readonly isDashed: boolean;
}

export interface LampMark {
  readonly index: number;
  readonly at: Pixel;
  readonly isOutside: boolean;
  /** The direction in which the lamp lies, radians, where it is outside. */
  readonly towards: number;
}

const MARGIN_PX = 18;
const LAMP_PX = 9;
const RING_M = 0.025;
const RING_STEPS = 24;
const EDGE_STEPS = 6; // pieces of an edge, so that lenses bend it

/** Place on the sheet of a point in the world, CSS pixels; null behind the camera. */
export function onSheet(view: View, factor: number, point: Vector): Pixel | null {
  const pixel = project(view, point);
  return pixel && [(pixel[0] + 0.5) * factor, (pixel[1] + 0.5) * factor];
}

export function drawBox(sheet: Sheet, pose: Pose, bounds: Bounds, style: BoxStyle): void {
  const { context } = sheet;
  const points = corners(pose, bounds);
  context.setLineDash(style.isDashed ? [5, 4] : []);
  strokeTwice(sheet, style.color, () => {
    for (const [from, to] of EDGES) strokeEdge(sheet, points[from]!, points[to]!);
  });
  context.setLineDash([]);
}

/** A ring on a surface: where an object stands on it. */
export function drawRing(sheet: Sheet, { point, normal }: Footing, color: string): void {
  const side = normalized(cross(normal, Math.abs(normal[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  const across = cross(normal, side);
  const rim = Array.from({ length: RING_STEPS }, (_, index) => {
    const angle = (2 * Math.PI * index) / RING_STEPS;
    return add(point, add(scaled(side, RING_M * Math.cos(angle)), scaled(across, RING_M * Math.sin(angle))));
  });
  strokeTwice(sheet, color, () => {
    for (const [index, from] of rim.entries()) strokeEdge(sheet, from, rim[(index + 1) % RING_STEPS]!);
    strokeEdge(sheet, point, add(point, scaled(normal, RING_M)));
  });
}

/** Dark below the colour, so that it is seen on any picture. */
function strokeTwice({ context }: Sheet, color: string, draw: () => void): void {
  for (const [width, style] of [
    [3, "rgb(0 0 0 / 45%)"],
    [1.5, color],
  ] as const) {
    context.lineWidth = width;
    context.strokeStyle = style;
    context.beginPath();
    draw();
    context.stroke();
  }
}

function strokeEdge({ context, view, factor }: Sheet, from: Vector, to: Vector): void {
  let isDown = false;
  for (let step = 0; step <= EDGE_STEPS; step++) {
    const t = step / EDGE_STEPS;
    const mix = (axis: 0 | 1 | 2): number => from[axis] + (to[axis] - from[axis]) * t;
    const at = onSheet(view, factor, [mix(0), mix(1), mix(2)]);
    if (at && isDown) context.lineTo(...at);
    else if (at) context.moveTo(...at);
    isDown = at !== null;
  }
}

/** Where the marks of lamps lie; those beyond the picture's edge are kept at it. */
export function lampMarks(
  sheet: Pick<Sheet, "view" | "factor" | "width" | "height">,
  lamps: readonly ManualLight[],
): LampMark[] {
  return lamps.flatMap((light, index) => {
    if (!("position_m" in light)) return [];
    const at = onSheet(sheet.view, sheet.factor, light.position_m) ?? beyondEdge(sheet, light.position_m);
    const x = Math.max(MARGIN_PX, Math.min(sheet.width - MARGIN_PX, at[0]));
    const y = Math.max(MARGIN_PX, Math.min(sheet.height - MARGIN_PX, at[1]));
    const towards = Math.atan2(at[1] - y, at[0] - x);
    return { index, at: [x, y] as const, isOutside: x !== at[0] || y !== at[1], towards };
  });
}

/** Where to look for a point behind the camera: far beyond the edge that one has to turn towards. */
function beyondEdge({ view, width, height }: Pick<Sheet, "view" | "width" | "height">, point: Vector): Pixel {
  const [x, y] = cameraFromWorld(view, point);
  const far = (2 * (width + height)) / Math.max(Math.hypot(x, y), 1e-9);
  return [width / 2 + x * far, height / 2 + y * far];
}

export function drawLamp({ context }: Sheet, mark: LampMark, light: ManualLight, accent: string | null): void {
  const [x, y] = mark.at;
  context.lineWidth = 1.5;
  context.strokeStyle = accent ?? "#fff";
  context.fillStyle = hexFromLinear(light.color_linear);
  context.globalAlpha = mark.isOutside && !accent ? 0.7 : 1;
  context.shadowColor = "rgb(0 0 0 / 60%)";
  context.shadowBlur = 4;
  context.beginPath();
  context.arc(x, y, LAMP_PX * 0.55, 0, 2 * Math.PI);
  context.fill();
  context.beginPath();
  for (let ray = 0; ray < 8; ray++) {
    const [cos, sin] = [Math.cos((ray * Math.PI) / 4), Math.sin((ray * Math.PI) / 4)];
    context.moveTo(x + cos * LAMP_PX * 0.85, y + sin * LAMP_PX * 0.85);
    context.lineTo(x + cos * LAMP_PX * 1.3, y + sin * LAMP_PX * 1.3);
  }
  context.stroke();
  if (mark.isOutside) drawPointer(context, mark.at, mark.towards);
  context.globalAlpha = 1;
  context.shadowBlur = 0;
}

/** An arrow out of the picture, towards what it does not show. */
function drawPointer(context: CanvasRenderingContext2D, [x, y]: Pixel, towards: number): void {
  const along = (reach: number, turn: number): Pixel => [
    x + LAMP_PX * reach * Math.cos(towards + turn),
    y + LAMP_PX * reach * Math.sin(towards + turn),
  ];
  context.beginPath();
  context.moveTo(...along(1.9, 0));
  context.lineTo(...along(1.5, 0.35));
  context.lineTo(...along(1.5, -0.35));
  context.closePath();
  context.fill();
  context.stroke();
}

/** A line from a lamp straight down to the board's plane, which tells where it hangs. */
export function drawPlumbLine(sheet: Sheet, position: Vector, color: string): void {
  const { context } = sheet;
  context.setLineDash([2, 4]);
  context.lineWidth = 1.5;
  context.strokeStyle = color;
  context.beginPath();
  strokeEdge(sheet, position, [position[0], position[1], 0]);
  context.stroke();
  context.setLineDash([]);
}
