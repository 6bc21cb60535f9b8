// What the inspector shows.
import { computed, effect, signal } from "@preact/signals";
import type { SceneObject } from "../api/types";
import { lights, objects, sceneDocument } from "./scene";

export type InspectorTab = "object" | "lights" | "real" | "method" | "output";

export const inspectorTab = signal<InspectorTab>("object");
export const selectedObjectId = signal<string | null>(null);
export const selectedLight = signal<number | null>(null);

export const selectedObject = computed<SceneObject | null>(
  () => objects.value.find((item) => item.id === selectedObjectId.value) ?? null,
);

export function selectObject(id: string | null): void {
  selectedObjectId.value = id;
  selectedLight.value = null;
  if (id !== null) inspectorTab.value = "object";
}

export function selectLight(index: number | null): void {
  selectedLight.value = index;
  selectedObjectId.value = null;
  if (index !== null) inspectorTab.value = "lights";
}

export function selectReal(): void {
  selectedObjectId.value = null;
  selectedLight.value = null;
  inspectorTab.value = "real";
}

/** A selection ends with what was selected. */
export function followScene(): void {
  effect(() => {
    if (sceneDocument.value === null) return;
    const index = selectedLight.value;
    if (index !== null && (lights.value?.mode !== "manual" || index >= lights.value.manual.length)) {
      selectedLight.value = null;
    }
    const id = selectedObjectId.value;
    if (id !== null && !objects.value.some((item) => item.id === id)) selectedObjectId.value = null;
  });
}
