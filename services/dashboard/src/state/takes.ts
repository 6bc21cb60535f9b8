// Recordings, replay and snapshots.
import { computed, signal } from "@preact/signals";
import { API, request } from "../api/http";
import type { Recording, Replay, ReplayChange, Snapshot, Video, WantedPicture } from "../api/types";
import { uploadRecording } from "../api/upload";
import { frame } from "../live/picture";
import { sendShown } from "./assets";
import { noteTried, openDrawer, recordsRelit } from "./preferences";
import { announce, attempt, toast } from "./toasts";

const VIDEO_POLL_MS = 300;

export const recordings = signal<readonly Recording[]>([]);
/** Share of each video that is being made, by recording. */
export const videos = signal<ReadonlyMap<string, number>>(new Map());
export const replay = signal<Replay | null>(null);
/** Whether a recording is shown, which can be moved along. */
export const isMovable = computed(() => replay.value?.position_s != null);
export const snapshots = signal<readonly Snapshot[]>([]);
export const isTakingSnapshot = signal(false);

export const running = computed(() => recordings.value.find(isGrowing) ?? null);

export function isGrowing(recording: Recording): boolean {
  return recording.state === "waiting" || recording.state === "recording";
}

export async function readRecordings(): Promise<void> {
  const found = await attempt(() => request<readonly Recording[]>("GET", `${API}/recordings`));
  if (found) recordings.value = found;
}

export async function readReplay(): Promise<void> {
  const found = await attempt(() => request<Replay>("GET", `${API}/replay`));
  if (found) replay.value = found;
}

export async function readSnapshots(): Promise<void> {
  const found = await attempt(() => request<readonly Snapshot[]>("GET", `${API}/snapshots`));
  if (found) snapshots.value = found;
}

export async function startRecording(): Promise<void> {
  await attempt(() => request("POST", `${API}/recordings`, { body: { composites: recordsRelit.value } }));
  await readRecordings();
}

export async function stopRecording(id: string): Promise<void> {
  await attempt(() => request("POST", `${API}/recordings/${id}/stop`));
  await readRecordings();
}

/** Have the service make the video of a recording's relit pictures, its progress shown; whether it is there. */
export async function makeVideo(id: string): Promise<boolean> {
  const path = `${API}/recordings/${id}/video`;
  let video = await attempt(() => request<Video>("POST", path));
  while (video?.state === "making") {
    videos.value = new Map(videos.value).set(id, video.progress);
    await new Promise((resolve) => setTimeout(resolve, VIDEO_POLL_MS));
    video = await attempt(() => request<Video>("GET", path));
  }
  videos.value = new Map([...videos.value].filter(([each]) => each !== id));
  if (video?.state === "failed") toast(video.detail, "error");
  return video?.state === "ready";
}

export async function stopVideo(id: string): Promise<void> {
  await attempt(() => request("DELETE", `${API}/recordings/${id}/video`));
}

export async function deleteRecording(id: string): Promise<void> {
  await attempt(() => request("DELETE", `${API}/recordings/${id}`));
  await readRecordings();
}

// The end of an archive lists the names of its files.
const LISTED_BYTES = 8 << 20;

/** Whether a file is a recording, or a zipped dataset folder, and not something to be put into the scene. */
export async function isRecording(file: File): Promise<boolean> {
  const name = file.name.toLowerCase();
  if (!name.endsWith(".zip")) return name.endsWith(".mcap");
  const list = await file.slice(Math.max(0, file.size - LISTED_BYTES)).text();
  return /(^|[^a-z0-9_])rgb\.txt/.test(list);
}

/** Send a recording and show its first frame; its card tells what relighting lacks. */
export async function openRecording(file: File): Promise<void> {
  const kept = await sendShown(file.name, (progress) => uploadRecording(file, progress));
  if (!kept) return;
  announce(`${kept.id} was added to the recordings.`);
  await readRecordings();
  openDrawer("recordings");
  await showRecording(kept.id, { playing: false });
}

/** Show a recording in place of the camera; `settings` are those of the replay so far. */
export async function showRecording(id: string, settings: Partial<Replay> = {}): Promise<void> {
  const { position_s = 0, playing = true, rate = 1, loop = true } = settings;
  const body = { recording: id, position_s, playing, rate, loop };
  const shown = await attempt(() => request<Replay>("PUT", `${API}/replay`, { body }));
  if (shown) replay.value = shown;
}

export async function changeReplay(body: ReplayChange): Promise<void> {
  const shown = await attempt(() => request<Replay>("PATCH", `${API}/replay`, { body }));
  if (shown) replay.value = shown;
}

export function play(playing: boolean): Promise<void> {
  noteTried("camera");
  return changeReplay({ playing });
}

let wanted: { readonly position_s?: number; readonly step_frames?: number } | null = null;
let isSeeking = false;

/** Pause at a position; of those that come while one is being sought, only the newest counts. */
export function scrub(position_s: number): void {
  noteTried("camera");
  wanted = { position_s };
  if (replay.value) replay.value = { ...replay.value, position_s, playing: false };
  if (!isSeeking) void seekNewest();
}

/** Pause so many frames further on, or back. */
export function step(frames: number): void {
  noteTried("camera");
  wanted = { ...wanted, step_frames: (wanted?.step_frames ?? 0) + frames };
  if (!isSeeking) void seekNewest();
}

async function seekNewest(): Promise<void> {
  isSeeking = true;
  while (wanted !== null) {
    const body = { ...wanted, playing: false };
    wanted = null;
    await changeReplay(body);
  }
  isSeeking = false;
}

export async function backToLive(): Promise<void> {
  await attempt(() => request("DELETE", `${API}/replay`));
  await readReplay();
}

/** Take pictures of one frame; without `pictures`, of every view. */
export async function takeSnapshot(
  pictures: readonly WantedPicture[] | null,
  exr: boolean,
): Promise<Snapshot | undefined> {
  isTakingSnapshot.value = true;
  const body = { ...(pictures ? { pictures } : {}), exr, camera: frame.value?.node ?? null };
  const taken = await attempt(() => request<Snapshot>("POST", `${API}/snapshots`, { body }));
  isTakingSnapshot.value = false;
  if (taken) await readSnapshots();
  return taken;
}

const BEFORE_AFTER: readonly WantedPicture[] = [
  { name: "camera", view: "camera" },
  { name: "composite", view: "composite" },
];

/** Take the frame that is shown, before and after, and return where it is as a moving picture. */
export async function takeBeforeAfter(): Promise<{ readonly path: string; readonly name: string } | undefined> {
  const taken = await takeSnapshot(BEFORE_AFTER, false);
  if (!taken) return undefined;
  return { path: `${API}/snapshots/${taken.id}/before-after.gif`, name: `before-after-${taken.frame_id}.gif` };
}

export async function deleteSnapshot(id: string): Promise<void> {
  await attempt(() => request("DELETE", `${API}/snapshots/${id}`));
  await readSnapshots();
}
