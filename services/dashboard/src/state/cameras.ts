// The room's cameras, and whose picture this page shows: that of its address (`?camera=NAME`), else the first one's.
import { computed, signal } from "@preact/signals";
import type { CameraState } from "../api/types";

const NAME = "camera";

/** Those whose pictures the render server makes, in its order. */
export const cameras = signal<readonly Pick<CameraState, "name" | "status">[]>([]);
const wanted = signal<string | null>(new URLSearchParams(location.search).get(NAME));

/** The camera that was chosen, as long as it is there; null = the first one that sends. */
export const chosenCamera = computed<string | null>(() =>
  cameras.value.some((camera) => camera.name === wanted.value) ? wanted.value : null,
);

/** Look through a camera, also when this page is opened again. */
export function chooseCamera(name: string): void {
  wanted.value = name;
  const address = new URL(location.href);
  address.searchParams.set(NAME, name);
  history.replaceState(history.state, "", address);
}
