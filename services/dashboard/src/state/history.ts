// Revisions of the scene, undo and redo.
import { computed, signal } from "@preact/signals";
import { request } from "../api/http";
import type { RevisionEntry, SceneAnswer } from "../api/types";
import { settled } from "./pending";
import { change, scene, scenePath } from "./scene";
import { announce, attempt } from "./toasts";

export const revisions = signal<readonly RevisionEntry[]>([]);

export interface Step {
  readonly entry: RevisionEntry;
  /** Changes of one gesture, which undo together. */
  readonly count: number;
}

/** The revisions, the newest first, with each gesture as one. */
export const steps = computed<readonly Step[]>(() => stepsOf(revisions.value));

export function stepsOf(entries: readonly RevisionEntry[]): Step[] {
  const found: Step[] = [];
  for (const entry of entries) {
    const last = found.at(-1);
    if (last && entry.gesture !== null && last.entry.gesture === entry.gesture) {
      found[found.length - 1] = { ...last, count: last.count + 1 };
    } else {
      found.push({ entry, count: 1 });
    }
  }
  return found;
}

export async function readRevisions(): Promise<void> {
  if (scene.value === null) {
    revisions.value = [];
    return;
  }
  const found = await attempt(() => request<readonly RevisionEntry[]>("GET", scenePath("/revisions")));
  if (found) revisions.value = [...found].sort((a, b) => b.revision - a.revision);
}

// Keys come faster than answers: each undo or redo begins when the one before it is answered.
let last: Promise<void> = Promise.resolve();

export function undo(): Promise<void> {
  last = last.then(async () => {
    await settled();
    if (scene.value?.can_undo !== true) return;
    if (await change("POST", "/undo", undefined, { strict: true })) announce("Undone.");
  });
  return last;
}

export function redo(): Promise<void> {
  last = last.then(async () => {
    await settled();
    if (scene.value?.can_redo !== true) return;
    if (await change("POST", "/redo", undefined, { strict: true })) announce("Redone.");
  });
  return last;
}

/** Make the scene as it was at a revision; that is a change too, and can be undone. */
export async function restore(revision: number): Promise<void> {
  const then = await attempt(() => request<SceneAnswer>("GET", scenePath(`/revisions/${revision}`)));
  if (!then) return;
  const body = { ...then.document, revision: scene.value?.revision };
  if (await change("PUT", "", body, { strict: true })) announce(`Revision ${revision} restored.`);
}
