// What people do to the scene, in one step each.
import { API, request } from "../api/http";
import type { AssetAnswer, LightType, ManualLight, Method, MethodName, Pose, SceneAnswer } from "../api/types";
import { boundsOf, longestEdge, restOn, sensibleScale } from "../math/bounds";
import type { Pixel } from "../math/camera";
import { UP } from "../math/vector";
import { size, trimmed } from "../math/units";
import { assetName, boundsByObject } from "./assets";
import { footprintOf } from "./freeSpace";
import { edit } from "./gesture";
import { rounded } from "./handle";
import { isTooSteep, pick, pointAt, restingOn, roomBeside, roomInMiddle } from "./placing";
import { change, lights, objects, readScene, readScenes, sceneDocument, takeScene } from "./scene";
import { selectLight, selectObject } from "./selection";
import { documentTarget, objectTarget, partTarget } from "./targets";
import { announce, attempt, toast } from "./toasts";
import { tool } from "./tools";

const UPRIGHT: Pose = { translation_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], scale: 1 };

/** Add an object of an asset, named as a file, playing a clip: at a pixel, or where the picture has room for it. */
export async function addObject(
  asset: AssetAnswer,
  pixel: Pixel | null = null,
  name = assetName(asset),
  clip: string | null = null,
): Promise<void> {
  if (!(await ensureScene())) return;
  const bounds = boundsOf(asset, null);
  const scale = bounds ? sensibleScale(bounds) : 1;
  const pose: Pose = { ...UPRIGHT, scale };
  const point = pixel ? await pointAt(pixel, footprintOf(pose, bounds).radius) : await roomInMiddle(pose, bounds);
  const id = freeId(name);
  const moves = clip === null ? {} : { animation: { clip }, rigid: false };
  const body = { id, asset: asset.asset, pose: rounded(restOn(pose, bounds, point, UP)), ...moves };
  if (!(await change("POST", "/objects", body))) return;
  selectObject(id);
  announce(`${id} added.`);
  if (bounds && scale !== 1) {
    const edge = longestEdge(bounds);
    toast(`${id} is ${size(edge)} long in its file, so it was added at scale ${trimmed(scale, 9)}.`);
  }
}

/** A name for a new object: the file's, with a number where it is taken. */
function freeId(fileName: string): string {
  const stem = fileName.replace(/\.[^.]*$/, "").slice(0, 100) || "object";
  const taken = new Set(objects.value.map((item) => item.id));
  let id = stem;
  for (let number = 2; taken.has(id); number++) id = `${stem} ${number}`;
  return id;
}

async function ensureScene(): Promise<boolean> {
  return sceneDocument.value !== null || (await newScene("My scene")) !== undefined;
}

export async function newScene(name: string): Promise<SceneAnswer | undefined> {
  const made = await attempt(() => request<SceneAnswer>("POST", `${API}/scenes`, { body: { name } }));
  return made && activateScene(made.id);
}

export function renameScene(name: string): Promise<number | null> {
  return edit(documentTarget, { name });
}

export async function activateScene(id: string): Promise<SceneAnswer | undefined> {
  const answer = await attempt(() => request<SceneAnswer>("POST", `${API}/scenes/${id}/activate`));
  if (!answer) return undefined;
  selectObject(null);
  await readScene();
  takeScene(answer);
  await readScenes();
  return answer;
}

export async function duplicateScene(id: string): Promise<void> {
  const made = await attempt(() => request<SceneAnswer>("POST", `${API}/scenes/${id}/duplicate`));
  if (made) await activateScene(made.id);
}

export async function deleteScene(id: string): Promise<void> {
  await attempt(() => request("DELETE", `${API}/scenes/${id}`));
  await readScenes();
}

export async function removeObject(id: string): Promise<void> {
  const removed = await change("DELETE", `/objects/${encodeURIComponent(id)}`);
  if (removed) announce(`${id} removed. Undo restores it.`);
}

/** Put a copy of an object beside it, turned as it is. */
export async function duplicateObject(id: string): Promise<void> {
  const item = objects.value.find((each) => each.id === id);
  if (!item) return;
  const bounds = boundsByObject.value.get(id) ?? null;
  const pose = restOn(item.pose, bounds, await roomBeside(item), UP);
  const copy = { ...item, id: freeId(id), pose: rounded(pose) };
  if (await change("POST", "/objects", copy)) selectObject(copy.id);
}

export function setVisible(id: string, visible: boolean): Promise<number | null> {
  return edit(objectTarget(id), { visible });
}

/** Stand an object on what the picture shows at a pixel, as dragging it there does. */
export async function placeObject(id: string, pixel: Pixel): Promise<void> {
  const item = objects.value.find((each) => each.id === id);
  const found = await pick(pixel);
  if (!item || !found) return;
  if (!found.point_m || found.object === id) {
    toast(
      found.object === id
        ? "Click next to the object, where it should stand."
        : "There is no surface there. Click somewhere else.",
    );
    return;
  }
  const normal = found.normal ?? UP;
  if (isTooSteep(normal)) {
    toast("That surface is too steep to stand on. Click a level one, or switch on Lean with surfaces.");
    return;
  }
  const pose = restingOn(item.pose, boundsByObject.value.get(id) ?? null, found.point_m, normal);
  tool.value = "move";
  await edit(objectTarget(id), { pose: rounded(pose) });
}

export async function addLight(type: LightType): Promise<void> {
  const index = lights.value?.manual.length ?? 0;
  if (await change("POST", "/lights/manual", { type })) selectLight(index);
}

export async function replaceLight(index: number, light: Partial<ManualLight>): Promise<void> {
  await change("PUT", `/lights/manual/${index}`, light, { strict: true });
}

export async function removeLight(index: number): Promise<void> {
  if (await change("DELETE", `/lights/manual/${index}`, undefined, { strict: true })) {
    selectLight(null);
    announce("Light removed. Undo restores it.");
  }
}

export function setMethod(name: MethodName): Promise<number | null> {
  return edit(partTarget("method"), { name });
}

export function methodOf(name: MethodName): Method | { name: MethodName } {
  const current = sceneDocument.value?.method;
  return current?.name === name ? current : { name };
}
