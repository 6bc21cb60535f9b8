// Events of the service, which keep every browser in step.
import { signal } from "@preact/signals";
import { API } from "../api/http";
import { role, version } from "../api/session";
import type { PictureState, ProcessAnswer, Recording, Replay } from "../api/types";
import { ReconnectingSocket } from "../live/socket";
import { readAssets, readShelf } from "./assets";
import { cameras } from "./cameras";
import { readRevisions } from "./history";
import { readState, takeReport } from "./processes";
import { readRooms } from "./rooms";
import { readScene, readScenes, scene, takePicture } from "./scene";
import { readRecordings, readReplay, readSnapshots, replay } from "./takes";
import { toast } from "./toasts";

interface Event {
  readonly type: string;
  readonly [key: string]: unknown;
}

/** Whether everything was read once: before, nothing can be said to be missing. */
export const isRead = signal(false);

const socket = new ReconnectingSocket(`${API}/events`, (message) => {
  if (typeof message.data === "string") void take(JSON.parse(message.data) as Event);
});

export function startEvents(): void {
  socket.start();
}

export function stopEvents(): void {
  socket.stop();
}

/** Read everything: at the start, and after events were missed. */
export async function readAll(): Promise<void> {
  await Promise.all([
    readScene(),
    readScenes(),
    readAssets(),
    readShelf(),
    readState(),
    readRecordings(),
    readReplay(),
    readSnapshots(),
    readRooms(),
  ]);
  await readRevisions();
  isRead.value = true;
}

async function take(event: Event): Promise<void> {
  switch (event.type) {
    case "hello":
      return takeHello(event as unknown as Hello);
    case "lost":
      return readAll();
    case "scene":
      return takeSceneEvent(event as unknown as SceneEvent);
    case "asset":
      return readAssets();
    case "process": {
      takeReport(event as unknown as ProcessAnswer);
      return;
    }
    case "recording":
      return takeRecording(event as unknown as Partial<Recording>);
    case "replay":
      replay.value = event as unknown as Replay;
      return;
    case "snapshot":
      return readSnapshots();
    case "picture": {
      takePictureEvent(event as unknown as PictureEvent);
      return;
    }
    case "rooms":
      return readRooms();
    case "cameras": {
      cameras.value = event.cameras as typeof cameras.value;
      return;
    }
    case "notice": {
      toast(String(event.text));
      return;
    }
  }
}

interface Hello {
  readonly version: string;
  readonly role: "view" | "control";
}

interface SceneEvent {
  readonly id: string;
  readonly revision: number;
  readonly active: boolean;
}

type PictureEvent = PictureState & { readonly scene_id: string };

/** The first event of each connection: what happened before it is not known, and the service may be another one. */
async function takeHello(hello: Hello): Promise<void> {
  if (version.value !== "" && version.value !== hello.version) {
    location.reload();
    return;
  }
  role.value = hello.role;
  version.value = hello.version;
  await readAll();
}

async function takeSceneEvent(event: SceneEvent): Promise<void> {
  const current = scene.value;
  const isNews = event.active
    ? current?.id !== event.id || event.revision > current.revision
    : current?.id === event.id;
  await readScenes();
  if (isNews) await readScene();
  await readRevisions();
}

function takePictureEvent({ scene_id, state, revision, detail }: PictureEvent): void {
  takePicture(scene_id, { state, revision, detail });
}

async function takeRecording(event: Partial<Recording>): Promise<void> {
  if (event.detail) toast(event.detail, "error");
  await readRecordings();
}
