// The live picture: newest frame drawn and acknowledged, its header shared with everything that goes over it.
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals";
import { API } from "../api/http";
import type { LiveHeader } from "../api/types";
import { lensOf, type View } from "../math/camera";
import { lookedAt } from "../state/scene";
import { noteDrawn } from "./delay";
import { RateMeter } from "./rate";
import { note, slowestMs } from "./telemetry";
import { parseLiveMessage } from "./message";
import { ReconnectingSocket, type Connection } from "./socket";

// A frame is late when three of the slowest of the last minute would have fitted in, within these bounds.
const LATE_FRAMES = 3;
const LATE_MS = { least: 1500, most: 10_000 };
const TICK_MS = 500;

export const frame = signal<LiveHeader | null>(null);
export const pictureSize = signal<{ readonly width: number; readonly height: number } | null>(null);
/** Pictures a second. */
export const rate = signal<number | null>(null);
/** How long the next frame has kept this page waiting, ms; 0 until it is late. */
export const lateMs = signal(0);
const meter = new RateMeter();
let lastArrival = 0;
let canvas: HTMLCanvasElement | null = null;

const socket = new ReconnectingSocket(`${API}/live`, (event) => void receive(event));
export const connection = socket.state as ReadonlySignal<Connection>;

effect(() => {
  const view = lookedAt.value ?? "";
  if (connection.value === "open") socket.send(`view ${view}`);
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
  watch = setInterval(tick, TICK_MS);
}

function tick(): void {
  const now = performance.now();
  rate.value = meter.rate(now);
  lateMs.value = frame.value === null ? 0 : lateBy(now - lastArrival, slowestMs());
}

/** How long a frame has been waited for, where that is longer than frames took; else 0. */
export function lateBy(sinceMs: number, frameMs: number): number {
  const patienceMs = Math.max(LATE_MS.least, Math.min(LATE_MS.most, LATE_FRAMES * frameMs));
  return sinceMs > patienceMs ? sinceMs : 0;
}

export function stopPicture(): void {
  socket.stop();
}

export function retryPicture(): void {
  socket.retry();
}

async function receive(event: MessageEvent<unknown>): Promise<void> {
  if (!(event.data instanceof ArrayBuffer)) return;
  const arrival = performance.now();
  try {
    const { header, jpeg } = parseLiveMessage(event.data);
    const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    draw(bitmap, header);
    noteDrawn(header.age_ms, arrival);
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
  lateMs.value = 0;
  meter.note(header.number, lastArrival);
  rate.value = meter.rate(lastArrival);
  frame.value = header;
  note(header, lastArrival, rate.value);
}
