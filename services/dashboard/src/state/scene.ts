// The scene that is rendered: as the service has it, with this browser's changes on their way laid over it.
import { computed, signal } from "@preact/signals";
import { API, ProblemError, request } from "../api/http";
import type { PictureState, SceneAnswer, SceneDocument, SceneSummary, View } from "../api/types";
import { settled } from "./pending";
import { noteTried } from "./preferences";
import { attempt, tell, toast } from "./toasts";

export type Overlay = (document: SceneDocument) => SceneDocument;

const served = signal<SceneAnswer | null>(null);
const overlays = signal<ReadonlyMap<object, Overlay>>(new Map());

export const scenes = signal<readonly SceneSummary[]>([]);
export const isSceneRead = signal(false);
export const scene = served as { readonly value: SceneAnswer | null };
export const sceneDocument = computed<SceneDocument | null>(() => {
  if (served.value === null) return null;
  return [...overlays.value.values()].reduce((document, overlay) => overlay(document), served.value.document);
});
export const objects = computed(() => sceneDocument.value?.objects ?? []);
/** What this page looks at in place of the document's own view, until that changes; others look at what they like. */
const chosenView = signal<{ readonly view: View; readonly insteadOf: View } | null>(null);
const ownView = computed<View | null>(() => served.value?.document.output.view ?? null);
export const lookedAt = computed<View | null>(() => {
  const chosen = chosenView.value;
  return chosen?.insteadOf === ownView.value ? chosen.view : null;
});
export const shownView = computed<View | null>(() => lookedAt.value ?? ownView.value);
export const lights = computed(() => sceneDocument.value?.lights ?? null);

export function overlay(key: object, change: Overlay | null): void {
  const next = new Map(overlays.value);
  if (change === null) next.delete(key);
  else next.set(key, change);
  overlays.value = next;
}

export function scenePath(rest = ""): string {
  return `${API}/scenes/${served.value?.id ?? "none"}${rest}`;
}

/** Take a scene that the service answered, unless a newer one is there. */
export function takeScene(answer: SceneAnswer): void {
  const current = served.value;
  if (current?.id === answer.id && current.revision > answer.revision) return;
  served.value = answer;
}

/** Take what the render server made of the scene. */
export function takePicture(sceneId: string, picture: PictureState): void {
  const current = served.value;
  if (current?.id !== sceneId || (current.picture && current.picture.revision > picture.revision)) return;
  if (picture.state === "refused" && current.picture?.detail !== picture.detail) toast(picture.detail, "error");
  served.value = { ...current, picture };
}

export async function readScene(): Promise<void> {
  try {
    served.value = await request<SceneAnswer>("GET", `${API}/active-scene`);
  } catch (fault) {
    if (fault instanceof ProblemError && fault.status === 404) served.value = null;
    else tell(fault);
  }
  isSceneRead.value = true;
}

/** Look at the scene in another way; nobody else sees that, and it is no change of the scene. */
export function setView(view: View): void {
  chosenView.value = ownView.value === null ? null : { view, insteadOf: ownView.value };
}

export async function readScenes(): Promise<void> {
  const found = await attempt(() => request<readonly SceneSummary[]>("GET", `${API}/scenes`));
  if (found) scenes.value = found;
}

interface ChangeOptions {
  /** Refuse the change where the scene is no longer the one that is shown here. */
  readonly strict?: boolean;
  readonly gesture?: string | undefined;
}

/** Change the scene; a refusal is told, and null comes back. */
export async function change(
  method: string,
  rest: string,
  body?: unknown,
  options: ChangeOptions = {},
): Promise<SceneAnswer | null> {
  try {
    if (options.strict === true) await settled();
    const ifMatch = options.strict === true ? served.value?.revision : undefined;
    const answer = await request<SceneAnswer>(method, scenePath(rest), { body, ifMatch, gesture: options.gesture });
    takeScene(answer);
    noteChange(method, rest, body);
    if (answer.picture?.state === "refused") toast(answer.picture.detail, "error");
    return answer;
  } catch (fault) {
    await tellChange(fault);
    return null;
  }
}

/** Tick off what the guide proposes. */
function noteChange(method: string, rest: string, body: unknown): void {
  if (rest.startsWith("/lights")) noteTried("light");
  else if (method === "POST" && rest === "/objects") noteTried("drop");
  else if (rest.startsWith("/objects/") && typeof body === "object" && body !== null && "pose" in body)
    noteTried("drag");
}

async function tellChange(fault: unknown): Promise<void> {
  if (!(fault instanceof ProblemError && fault.isStale)) {
    tell(fault);
    return;
  }
  await readScene();
  const what = served.value ? ` (${served.value.what}, revision ${served.value.revision})` : "";
  toast(
    `Somebody else changed the scene first${what}. The scene was reloaded; check it, then repeat your change.`,
    "error",
  );
}
