// The live picture: newest frame drawn and acknowledged, its header shared with everything that goes over it.
import { computed, signal } from "@preact/signals";
import { API } from "../api/http";
import type { LiveHeader } from "../api/types";
import { lensOf, type View } from "../math/camera";
import { note } from "./telemetry";
import { parseLiveMessage } from "./message";
import { ReconnectingSocket } from "./socket";

// A picture is stale when three frames are missing, within these bounds.
const STALE_MS = { least: 1500, most: 10_000 };

export const frame = signal<LiveHeader | null>(null);
export const pictureSize = signal<{ readonly width: number; readonly height: number } | null>(null);
const isStale = signal(false);
let lastArrival = 0;
let canvas: HTMLCanvasElement | null = null;

const socket = new ReconnectingSocket(`${API}/live`, (event) => void receive(event));

export const liveState = computed<"connecting" | "reconnecting" | "waiting" | "stale" | "no-board" | "live">(() => {
  if (socket.state.value !== "open") return frame.value === null ? "connecting" : "reconnecting";
  if (frame.value === null) return "waiting";
  if (isStale.value) return "stale";
  return frame.value.status === "ok" ? "live" : "no-board";
});

/** The newest frame's camera in the world; null without a pose. */
export const view = computed<View | null>(() => {
  const header = frame.value;
  if (!header?.world_from_camera) return null;
  return { lens: lensOf(header.camera), worldFromCamera: header.world_from_camera };
});

export function showPictureOn(target: HTMLCanvasElement | null): void {
  canvas = target;
}

let watch: ReturnType<typeof setInterval> | undefined;

export function startPicture(): void {
  socket.start();
  clearInterval(watch);
  watch = setInterval(
    () => (isStale.value = performance.now() - lastArrival > staleAfterMs(frame.value?.frames_per_s)),
    500,
  );
}

function staleAfterMs(framesPerS: number | null | undefined): number {
  return Math.max(STALE_MS.least, Math.min(STALE_MS.most, 3000 / (framesPerS ?? 1)));
}

export function stopPicture(): void {
  socket.stop();
}

export function retryPicture(): void {
  socket.retry();
}

async function receive(event: MessageEvent<unknown>): Promise<void> {
  if (!(event.data instanceof ArrayBuffer)) return;
  try {
    const { header, jpeg } = parseLiveMessage(event.data);
    const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    draw(bitmap, header);
    bitmap.close();
  } finally {
    socket.send("ack");
  }
}

function draw(bitmap: ImageBitmap, header: LiveHeader): void {
  const { width, height } = bitmap;
  if (pictureSize.value?.width !== width || pictureSize.value.height !== height) pictureSize.value = { width, height };
  if (canvas) {
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
  }
  lastArrival = performance.now();
  isStale.value = false;
  frame.value = header;
  note(header, lastArrival);
}
