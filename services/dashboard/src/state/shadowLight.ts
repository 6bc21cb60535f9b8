// A light from two clicks: the tip of a shadow that the picture shows, and what throws it.
import { signal } from "@preact/signals";
import { brightnessAt, view } from "../live/picture";
import { project, type Pixel } from "../math/camera";
import { levelled } from "../math/bounds";
import { besideTip, directionFrom, irradianceFrom } from "../math/sunlight";
import { UP } from "../math/vector";
import type { Vector } from "../api/types";
import { pick } from "./placing";
import { change, lights } from "./scene";
import { selectLight } from "./selection";
import { announce, toast } from "./toasts";
import { tool, type Footing } from "./tools";

/** The tip, once it was clicked. */
export const shadowTip = signal<Footing | null>(null);

const NO_SURFACE = "There is no real surface there. Click somewhere else.";

/** Wait for the two clicks. */
export function beginShadowLight(): void {
  shadowTip.value = null;
  tool.value = "shadow";
}

export async function takeShadowClick(pixel: Pixel): Promise<void> {
  const found = await pick(pixel);
  if (!found) return;
  if (found.kind !== "real" || !found.point_m) toast(NO_SURFACE);
  else if (!shadowTip.value) shadowTip.value = { point: found.point_m, normal: levelled(found.normal ?? UP) };
  else await addLightFrom(shadowTip.value, found.point_m);
}

async function addLightFrom(tip: Footing, thrower: Vector): Promise<void> {
  const direction = directionFrom(tip.point, thrower, tip.normal);
  if (!direction) {
    toast(
      "That point cannot cast this shadow: it lies behind the surface or at the tip. Click the point that casts it.",
    );
    return;
  }
  tool.value = "move";
  const irradiance = strengthOf(tip, direction);
  const index = lights.value?.manual.length ?? 0;
  const light = { type: "directional", direction, ...(irradiance === null ? {} : { irradiance }) };
  if (!(await change("POST", "/lights/manual", light))) return;
  selectLight(index);
  announce("Light added along the shadow.");
  if (irradiance === null) toast("The shadow is too faint to estimate the strength of its light. Set it under Lights.");
}

/** By how much brighter the surface is beyond the tip than before it, in the picture that is shown. */
function strengthOf({ point, normal }: Footing, direction: Vector): number | null {
  const [lit, dark] = besideTip(point, normal, direction).map((each) => {
    const pixel = view.value && project(view.value, each);
    return pixel ? brightnessAt(pixel) : null;
  });
  if (lit == null || dark == null) return null;
  const found = irradianceFrom(lit, dark, normal, direction);
  return found === null ? null : Number(found.toPrecision(3));
}
