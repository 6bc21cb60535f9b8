// What the gizmo and the arrow keys hold: the selected object or light, as a pose that can be changed.
import { computed } from "@preact/signals";
import type { ManualLight, Pose, Vector } from "../api/types";
import { rotate, turnBetween } from "../math/rotation";
import { Gesture } from "./gesture";
import { lights } from "./scene";
import { selectedLight, selectedObject } from "./selection";
import { lightTarget, objectTarget, type Patch, type Target } from "./targets";
import { draft, type Tool } from "./tools";

export interface Handle {
  readonly key: string;
  readonly pose: Pose;
  readonly tools: readonly Tool[];
  readonly target: Target;
  readonly patch: (pose: Pose) => Patch;
  /** The object whose outline follows; null for lights. */
  readonly objectId: string | null;
}

/** Lamps shine along -z of their own frame. */
const SHINES: Vector = [0, 0, -1];

export const handle = computed<Handle | null>(() => objectHandle() ?? lightHandle());

function objectHandle(): Handle | null {
  const item = selectedObject.value;
  if (item?.frame !== "world") return null;
  return {
    key: `object ${item.id}`,
    pose: item.pose,
    tools: ["move", "rotate", "scale"],
    target: objectTarget(item.id),
    patch: (pose) => ({ pose }),
    objectId: item.id,
  };
}

function lightHandle(): Handle | null {
  const index = selectedLight.value;
  const light = index === null ? undefined : lights.value?.manual[index];
  if (index === null || !light || !("position_m" in light)) return null;
  const direction = "direction" in light ? light.direction : null;
  return {
    key: `light ${index} ${light.type}`,
    pose: {
      translation_m: light.position_m,
      rotation_wxyz: direction ? turnBetween(SHINES, direction) : [1, 0, 0, 0],
      scale: 1,
    },
    tools: direction ? ["move", "rotate"] : ["move"],
    target: lightTarget(index),
    patch: (pose) => lightPatch(light, pose),
    objectId: null,
  };
}

function lightPatch(light: ManualLight, pose: Pose): Patch {
  const position_m = pose.translation_m;
  return "direction" in light ? { position_m, direction: rotate(pose.rotation_wxyz, SHINES) } : { position_m };
}

/** A drag of a handle, from its start to its end. */
export class HandleDrag {
  private readonly gesture: Gesture;
  readonly start: Pose;

  constructor(private readonly held: Handle) {
    this.gesture = new Gesture(held.target);
    this.start = held.pose;
  }

  move(pose: Pose): void {
    const tidy = rounded(pose);
    this.gesture.push(this.held.patch(tidy));
    if (this.held.objectId !== null) draft.value = { id: this.held.objectId, pose: tidy, revision: null };
  }

  async end(): Promise<void> {
    const revision = await this.gesture.end();
    const current = draft.value;
    if (current?.id === this.held.objectId) draft.value = revision === null ? null : { ...current, revision };
  }
}

/** A pose without the digits that mean nothing: a hundredth of a millimetre, and as much of a turn. */
export function rounded(pose: Pose): Pose {
  const round = (value: number, digits: number): number => Number(value.toFixed(digits));
  const [x, y, z] = pose.translation_m;
  const [w, a, b, c] = pose.rotation_wxyz;
  return {
    translation_m: [round(x, 5), round(y, 5), round(z, 5)],
    rotation_wxyz: [round(w, 6), round(a, 6), round(b, 6), round(c, 6)],
    scale: Number(pose.scale.toPrecision(5)),
  };
}
