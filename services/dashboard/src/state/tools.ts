// The tool in hand, and what is drawn over the picture.
import { effect, signal } from "@preact/signals";
import type { Pose, Vector } from "../api/types";
import { frame } from "../live/picture";

export type Tool = "select" | "move" | "rotate" | "scale" | "place" | "shadow";

export const tool = signal<Tool>("move");
/** Snapping without Shift held; Shift then lets go. */
export const isSnapping = signal(false);
export const areOutlinesShown = signal(true);
/** The room in 3-D in place of the picture. */
export const isRoomShown = signal(false);

/** An object's pose that the picture does not show yet: where it is dragged to, until a frame has it. */
export interface Draft {
  readonly id: string;
  readonly pose: Pose;
  /** The scene's revision that holds the pose; null while dragging. */
  readonly revision: number | null;
}

export const draft = signal<Draft | null>(null);

/** Where on a surface an object stands while it is dragged. */
export interface Footing {
  readonly point: Vector;
  readonly normal: Vector;
}

export const footing = signal<Footing | null>(null);

/** A draft ends with the first frame that shows its revision. */
export function followFrames(): void {
  effect(() => {
    const awaited = draft.value?.revision ?? Infinity;
    if ((frame.value?.scene?.revision ?? 0) >= awaited) draft.value = null;
  });
}
