import { useSignalEffect, type ReadonlySignal } from "@preact/signals";
import { useRef } from "preact/hooks";
import { pictureSize, view } from "../../live/picture";
import { boundsByObject } from "../../state/assets";
import { lights, objects } from "../../state/scene";
import { selectedLight, selectedObjectId } from "../../state/selection";
import { shadowTip } from "../../state/shadowLight";
import { areOutlinesShown, draft, footing, tool } from "../../state/tools";
import { drawBox, drawLamp, drawPlumbLine, drawRing, lampMarks, type Sheet } from "./outlines";
import type { Box } from "./fit";
import { hovered } from "./pointer";

/** Boxes of the selected and the pointed-at object, and marks of the lamps. */
export function Outlines({ box }: { readonly box: ReadonlySignal<Box> }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useSignalEffect(() => {
    const sheet = canvas.current && sheetOn(canvas.current, box.value);
    if (!sheet || !areOutlinesShown.value) return;
    const accent = getComputedStyle(document.documentElement).getPropertyValue("--on-picture").trim();
    drawObjects(sheet, accent);
    const place = tool.value === "shadow" ? shadowTip.value : footing.value;
    if (place) drawRing(sheet, place, accent);
    if (lights.value?.mode === "manual") drawLamps(sheet, accent);
  });
  return <canvas class="layer" ref={canvas} aria-hidden="true" />;
}

function sheetOn(canvas: HTMLCanvasElement, { width, height }: Box): Sheet | null {
  const ratio = devicePixelRatio;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  if (!context || !view.value || !pictureSize.value || width === 0) return null;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { context, view: view.value, factor: width / view.value.lens.width, width, height };
}

function drawObjects(sheet: Sheet, accent: string): void {
  for (const item of objects.value) {
    const bounds = boundsByObject.value.get(item.id);
    const isSelected = item.id === selectedObjectId.value;
    if (!bounds || item.frame !== "world" || !(isSelected || item.id === hovered.value)) continue;
    const moving = draft.value?.id === item.id ? draft.value.pose : null;
    const color = isSelected ? accent : "rgb(255 255 255 / 80%)";
    drawBox(sheet, moving ?? item.pose, bounds, { color, isDashed: moving !== null });
  }
}

function drawLamps(sheet: Sheet, accent: string): void {
  const lamps = lights.value?.manual ?? [];
  for (const mark of lampMarks(sheet, lamps)) {
    const light = lamps[mark.index]!;
    const isSelected = mark.index === selectedLight.value;
    if (isSelected && "position_m" in light) drawPlumbLine(sheet, light.position_m, accent);
    drawLamp(sheet, mark, light, isSelected ? accent : null);
  }
}
