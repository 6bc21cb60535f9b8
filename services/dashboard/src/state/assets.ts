// Uploaded files, and those on their way.
import { computed, signal } from "@preact/signals";
import { API, request } from "../api/http";
import type { AssetAnswer, Material, SceneObject, ShelfItem } from "../api/types";
import { uploadAsset } from "../api/upload";
import { boundsOfObject, type Bounds } from "../math/bounds";
import { objects } from "./scene";
import { announce, attempt } from "./toasts";

export interface Upload {
  readonly id: number;
  readonly name: string;
  /** 0..1; 1 = the service checks the file. */
  readonly share: number;
}

export const assets = signal<readonly AssetAnswer[]>([]);
/** Simple objects that the service makes. */
export const shelf = signal<readonly ShelfItem[]>([]);
export const uploads = signal<readonly Upload[]>([]);
let count = 0;

export const boundsByObject = computed<ReadonlyMap<string, Bounds>>(() => {
  const found = new Map<string, Bounds>();
  for (const item of objects.value) {
    const bounds = boundsOfObject(item, assets.value);
    if (bounds) found.set(item.id, bounds);
  }
  return found;
});

export async function readAssets(): Promise<void> {
  const found = await attempt(() => request<readonly AssetAnswer[]>("GET", `${API}/assets`));
  if (found) assets.value = found;
}

export async function readShelf(): Promise<void> {
  const found = await attempt(() => request<readonly ShelfItem[]>("GET", `${API}/shelf`));
  if (found) shelf.value = found;
}

/** Send a file; a refusal is told. */
export function upload(file: File): Promise<AssetAnswer | undefined> {
  return receive(file.name, (progress) => uploadAsset(file, progress));
}

/** Have the service make one of its simple objects; a refusal is told. */
export function takeFromShelf({ name, file_name }: ShelfItem): Promise<AssetAnswer | undefined> {
  return receive(file_name, (progress) => {
    progress(1);
    return request<AssetAnswer>("POST", `${API}/shelf/${name}`);
  });
}

async function receive(
  name: string,
  send: (progress: (share: number) => void) => Promise<AssetAnswer>,
): Promise<AssetAnswer | undefined> {
  const asset = await sendShown(name, send);
  if (asset) {
    announce(`${name} was added to the assets.`);
    await readAssets();
  }
  return asset;
}

/** Send a file, its progress shown; a refusal is told. */
export async function sendShown<Answer>(
  name: string,
  send: (progress: (share: number) => void) => Promise<Answer>,
): Promise<Answer | undefined> {
  const id = ++count;
  uploads.value = [...uploads.value, { id, name, share: 0 }];
  const progress = (share: number): void => {
    uploads.value = uploads.value.map((each) => (each.id === id ? { ...each, share } : each));
  };
  const answer = await attempt(() => send(progress));
  uploads.value = uploads.value.filter((each) => each.id !== id);
  return answer;
}

export async function removeAsset(asset: AssetAnswer): Promise<void> {
  await attempt(() => request("DELETE", `${API}/assets/${asset.asset}`));
  await readAssets();
}

// Of files that were uploaded before the service read their material.
const PLAIN: Material = {
  base_color: [0.8, 0.8, 0.8],
  metallic: 0,
  roughness: 0.5,
  specular: 0.5,
  ior: null,
  emission: [0, 0, 0],
  transmission: 0,
  thin_walled: false,
  attenuation_color: [1, 1, 1],
  attenuation_distance_m: null,
};

/** The material that an object's file gives it, to begin an override with. */
export function materialOfFile(item: SceneObject, known: readonly AssetAnswer[]): Material {
  const asset = known.find((each) => each.asset === item.asset);
  return { ...PLAIN, ...(asset?.facts.material as Partial<Material> | undefined) };
}

export function assetName(asset: AssetAnswer): string {
  return asset.names[0] ?? asset.asset;
}
