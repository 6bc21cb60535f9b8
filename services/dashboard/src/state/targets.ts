// What a change may be made to: an address below the scene, and the same change on the document in this browser.
import type { ManualLight, SceneDocument, SceneObject } from "../api/types";

export type Patch = Readonly<Record<string, unknown>>;

export interface Target {
  readonly path: string;
  readonly apply: (document: SceneDocument, patch: Patch) => SceneDocument;
}

export type Part = "real" | "lights" | "method" | "shading" | "output";

export function objectTarget(id: string): Target {
  return {
    path: `/objects/${encodeURIComponent(id)}`,
    apply: (document, patch) => ({
      ...document,
      objects: document.objects.map((item) => (item.id === id ? mergedObject(item, patch) : item)),
    }),
  };
}

export function partTarget(part: Part): Target {
  return {
    path: `/${part}`,
    apply: (document, patch) => ({ ...document, [part]: merged(document[part] as object, patch) }),
  };
}

export function lightTarget(index: number): Target {
  const change = (light: ManualLight, at: number, patch: Patch): ManualLight =>
    at === index ? merged(light, patch) : light;
  return {
    path: `/lights/manual/${index}`,
    apply: (document, patch) => ({
      ...document,
      lights: { ...document.lights, manual: document.lights.manual.map((light, at) => change(light, at, patch)) },
    }),
  };
}

export const documentTarget: Target = { path: "", apply: merged };

/** A JSON merge patch (RFC 7396). Defaults of removed keys come with the service's answer. */
export function merged<T extends object>(target: T, patch: Patch): T {
  const result = { ...target } as Record<string, unknown>;
  for (const [key, value] of Object.entries(patch)) {
    if (isPlain(value)) result[key] = merged(isPlain(result[key]) ? result[key] : {}, value);
    else result[key] = value;
  }
  return result as T;
}

/** As the service does it: a material in numbers and a precomputed one share no key, so one replaces the other. */
function mergedObject(item: SceneObject, patch: Patch): SceneObject {
  const { material } = patch;
  const isOther = item.material && isPlain(material) && "precomputed" in item.material !== "precomputed" in material;
  return merged(isOther ? { ...item, material: null } : item, patch);
}

function isPlain(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}
