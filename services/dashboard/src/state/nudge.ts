// Moving and turning the selection by keys.
import type { Pose, Vector } from "../api/types";
import { view } from "../live/picture";
import { column } from "../math/camera";
import { multiply, quaternionFromAngles } from "../math/rotation";
import { SNAP_DEG, SNAP_M } from "../math/snap";
import { add, scaled } from "../math/vector";
import { handle, HandleDrag, type Handle } from "./handle";

// Presses that follow each other faster are one for undo.
const PAUSE_MS = 1000;

let drag: HandleDrag | null = null;
let dragKey = "";
let timer: ReturnType<typeof setTimeout> | undefined;

/** Act on a key of the focused picture; false where it means nothing. */
export function nudge(event: KeyboardEvent): boolean {
  const held = handle.value;
  if (!held) return false;
  const step = SNAP_M * (event.shiftKey ? 10 : event.altKey ? 0.1 : 1);
  const pose = nudged(held, event.key, step);
  if (!pose) return false;
  if (dragKey !== held.key || !drag) drag = new HandleDrag(held);
  dragKey = held.key;
  drag.move(pose);
  clearTimeout(timer);
  timer = setTimeout(endNudge, PAUSE_MS);
  return true;
}

/** What comes next is a change of its own. */
export function endNudge(): void {
  void drag?.end();
  drag = null;
}

function nudged({ pose, tools }: Handle, key: string, step: number): Pose | null {
  const direction = directionOf(key);
  if (direction) return { ...pose, translation_m: add(pose.translation_m, scaled(direction, step)) };
  const turns = { "[": SNAP_DEG, "]": -SNAP_DEG }[key];
  if (turns === undefined || !tools.includes("rotate")) return null;
  return { ...pose, rotation_wxyz: multiply(quaternionFromAngles([0, 0, turns]), pose.rotation_wxyz) };
}

function directionOf(key: string): Vector | null {
  const right = nearestGroundAxis();
  const away: Vector = [-right[1], right[0], 0];
  switch (key) {
    case "ArrowRight":
      return right;
    case "ArrowLeft":
      return scaled(right, -1);
    case "ArrowUp":
      return away;
    case "ArrowDown":
      return scaled(away, -1);
    case "PageUp":
      return [0, 0, 1];
    case "PageDown":
      return [0, 0, -1];
    default:
      return null;
  }
}

/** The axis of the board's plane that points most to the right in the picture. */
function nearestGroundAxis(): Vector {
  const [x, y] = view.value ? column(view.value.worldFromCamera, 0) : [1, 0];
  return Math.abs(x) >= Math.abs(y) ? [Math.sign(x) || 1, 0, 0] : [0, Math.sign(y), 0];
}
