// What people do to the scene, in one step each.
import { API, request } from "../api/http";
import { lookAt } from "../live/pick";
import type {
  AssetAnswer,
  LightType,
  ManualLight,
  Method,
  MethodName,
  PickAnswer,
  Pose,
  SceneAnswer,
  Vector,
} from "../api/types";
import { boundsOf, longestEdge, restOn, sensibleScale, standOn, type Bounds } from "../math/bounds";
import { meetPlane, type Pixel } from "../math/camera";
import { UP } from "../math/vector";
import { size, trimmed } from "../math/units";
import { pictureSize, view } from "../live/picture";
import { assetName, boundsByObject } from "./assets";
import { beforeWall, footprintOf, freePlace, standable } from "./freeSpace";
import { edit } from "./gesture";
import { rounded } from "./handle";
import { change, lights, objects, readScene, readScenes, sceneDocument, takeScene } from "./scene";
import { selectLight, selectObject } from "./selection";
import { documentTarget, objectTarget, partTarget } from "./targets";
import { announce, attempt, toast } from "./toasts";
import { tool } from "./tools";

const UPRIGHT: Pose = { translation_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], scale: 1 };

export async function pick(pixel: Pixel): Promise<PickAnswer | undefined> {
  return attempt(() => lookAt(pixel));
}

/** Add an object of an asset, named as a file: at a pixel, or where the middle of the picture has room for it. */
export async function addObject(
  asset: AssetAnswer,
  pixel: Pixel | null = null,
  name = assetName(asset),
): Promise<void> {
  if (!(await ensureScene())) return;
  const bounds = boundsOf(asset, null);
  const scale = bounds ? sensibleScale(bounds) : 1;
  const pose: Pose = { ...UPRIGHT, scale };
  const point = pixel ? await pointAt(pixel, footprintOf(pose, bounds).radius) : await roomFor(pose, bounds);
  const id = freeId(name);
  const body = { id, asset: asset.asset, pose: rounded(restOn(pose, bounds, point, UP)) };
  if (!(await change("POST", "/objects", body))) return;
  selectObject(id);
  announce(`${id} added.`);
  if (bounds && scale !== 1) {
    const edge = longestEdge(bounds);
    toast(`${id} is ${size(edge)} long in its file, so it was added at scale ${trimmed(scale, 9)}.`);
  }
}

/** Where something new stands at a pixel: on the surface seen there, or on what is behind a virtual object. */
async function pointAt(pixel: Pixel, radius: number): Promise<Vector> {
  const first = await pick(pixel);
  const found = first?.kind === "object" && first.object ? await attempt(() => lookAt(pixel, first.object!)) : first;
  const point = standable(found);
  if (point) return point;
  toast("There is no level surface there, so the object stands on the plane of the board.");
  return found?.point_m ? beforeWall(found.point_m, found.normal, radius) : onBoard(pixel);
}

function onBoard(pixel: Pixel): Vector {
  return (view.value && meetPlane(view.value, pixel, [0, 0, 0], UP)) ?? [0, 0, 0];
}

/** The free place nearest to the picture's middle. */
async function roomFor(pose: Pose, bounds: Bounds | null): Promise<Vector> {
  if (!view.value) return [0, 0, 0];
  const taken = objects.value.flatMap((item) =>
    item.frame === "world" ? footprintOf(item.pose, boundsByObject.value.get(item.id) ?? null) : [],
  );
  const wanted = { view: view.value, pixel: centre(), pose, bounds, taken };
  const found = await freePlace(wanted, (at) => attempt(() => lookAt(at)));
  if (found) return found;
  toast("No free place was found, so the object stands in the middle of the picture. Drag it where you want it.");
  return onBoard(centre());
}

function centre(): Pixel {
  const { width, height } = pictureSize.value ?? { width: 0, height: 0 };
  return [(width - 1) / 2, (height - 1) / 2];
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
  if (removed) announce(`${id} removed. Undo brings it back.`);
}

export async function duplicateObject(id: string): Promise<void> {
  const item = objects.value.find((each) => each.id === id);
  if (!item) return;
  const [x, y, z] = item.pose.translation_m;
  const copy = { ...item, id: freeId(id), pose: { ...item.pose, translation_m: [x + 0.05, y, z] } };
  if (await change("POST", "/objects", copy)) selectObject(copy.id);
}

export function setVisible(id: string, visible: boolean): Promise<number | null> {
  return edit(objectTarget(id), { visible });
}

/** Stand an object on what the picture shows at a pixel. */
export async function placeObject(id: string, pixel: Pixel): Promise<void> {
  const item = objects.value.find((each) => each.id === id);
  const found = await pick(pixel);
  if (!item || !found) return;
  if (!found.point_m || found.object === id) {
    toast(
      found.object === id
        ? "Click next to the object, where it should stand."
        : "No surface was found there. Click somewhere else.",
    );
    return;
  }
  const pose = standOn(item.pose, boundsByObject.value.get(id) ?? null, found.point_m, found.normal ?? UP);
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
    announce("Light removed. Undo brings it back.");
  }
}

export function setMethod(name: MethodName): Promise<number | null> {
  return edit(partTarget("method"), { name });
}

export function methodOf(name: MethodName): Method | { name: MethodName } {
  const current = sceneDocument.value?.method;
  return current?.name === name ? current : { name };
}
