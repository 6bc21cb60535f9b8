// The live picture: newest frame drawn and acknowledged, its header shared with everything that goes over it.
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals";
import { API } from "../api/http";
import type { LiveHeader } from "../api/types";
import { lensOf, type Pixel, type View } from "../math/camera";
import { chosenCamera } from "../state/cameras";
import { lookedAt } from "../state/scene";
import { noteDrawn } from "./delay";
import { BitMeter, RateMeter } from "./rate";
import { note, slowestMs } from "./telemetry";
import { parseLiveMessage } from "./message";
import { ReconnectingSocket, type Connection } from "./socket";
import { noVideo, VideoPictures, videoProblem } from "./video";

// A frame is late when three of the slowest of the last minute would have fitted in, within these bounds.
const LATE_FRAMES = 3;
const LATE_MS = { least: 1500, most: 10_000 };
const TICK_MS = 500;
// Noise and pores of a surface are averaged over so many pixels to each side.
const PATCH_PX = 2;
// Of R, G and B (Rec. ITU-R BT.709).
const LUMINANCE = [
  [0, 0.2126],
  [1, 0.7152],
  [2, 0.0722],
] as const;

export const frame = signal<LiveHeader | null>(null);
export const pictureSize = signal<{ readonly width: number; readonly height: number } | null>(null);
/** Pictures a second. */
export const rate = signal<number | null>(null);
/** How long the next frame has kept this page waiting, ms; 0 until it is late. */
export const lateMs = signal(0);
const meter = new RateMeter();
/** What the pictures take on the network. */
export const bitrate = signal<number | null>(null);
const bits = new BitMeter();
let lastArrival = 0;
let canvas: HTMLCanvasElement | null = null;
/** Of the newest message, which the next one may build on. */
let lastHeader: LiveHeader | null = null;

const video = new VideoPictures(
  show,
  () => socket.send("ack"),
  (reason) => (noVideo.value = reason),
);
const socket = new ReconnectingSocket(`${API}/live`, (event) => void receive(event));
export const connection = socket.state as ReadonlySignal<Connection>;

effect(() => {
  const view = lookedAt.value ?? "";
  if (connection.value === "open") socket.send(`view ${view}`);
});

/** Whether the service was told of a camera by this connection. */
let isTurned = false;

effect(() => {
  const camera = chosenCamera.value;
  const isOpen = connection.value === "open";
  if (isOpen && (camera !== null || isTurned)) socket.send(`camera ${camera ?? ""}`);
  isTurned = isOpen && camera !== null;
});

effect(() => {
  if (connection.value === "open") return;
  lastHeader = null;
  video.close();
});

effect(() => {
  if (connection.value === "open") socket.send(`codec ${noVideo.value === null ? "h264" : "jpeg"}`);
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

/** Ask for H.264 where the service has it (else why not) and this browser decodes it. */
export async function chooseCodec(whyNot: string | null): Promise<void> {
  noVideo.value = whyNot ?? (await videoProblem());
}

export function startPicture(): void {
  socket.start();
  clearInterval(watch);
  watch = setInterval(tick, TICK_MS);
}

function tick(): void {
  const now = performance.now();
  rate.value = meter.rate(now);
  bitrate.value = bits.kilobits(now);
  video.checkAt(now);
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
  const { header, coded } = parseLiveMessage(event.data, lastHeader);
  lastHeader = header;
  bits.note(event.data.byteLength, arrival);
  if (header.codec !== "jpeg" && coded.length > 0 && noVideo.value === null) {
    video.decode(header, coded, arrival);
    return;
  }
  try {
    if (header.codec === "jpeg") await showJpeg(header, coded, arrival);
    else if (coded.length === 0 && video.isIdle) noteFrame(header, arrival); // the picture before is still right
  } finally {
    socket.send("ack");
  }
}

async function showJpeg(header: LiveHeader, coded: Uint8Array<ArrayBuffer>, arrival: number): Promise<void> {
  const bitmap = await createImageBitmap(new Blob([coded], { type: "image/jpeg" }));
  show(bitmap, header, arrival);
  bitmap.close();
}

/** Mean linear brightness around a pixel of the picture, as sRGB codes it; null outside. */
export function brightnessAt([x, y]: Pixel): number | null {
  const context = canvas?.getContext("2d");
  const [left, top] = [Math.round(x) - PATCH_PX, Math.round(y) - PATCH_PX];
  const edge = 2 * PATCH_PX + 1;
  if (!canvas || !context || left < 0 || top < 0 || left + edge > canvas.width || top + edge > canvas.height)
    return null;
  const { data } = context.getImageData(left, top, edge, edge);
  let sum = 0;
  for (let index = 0; index < data.length; index += 4)
    for (const [channel, weight] of LUMINANCE) sum += weight * linearFromCode(data[index + channel]!);
  return sum / (edge * edge);
}

function linearFromCode(code: number): number {
  const value = code / 255;
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}

/** Draw a picture; the codec may have enlarged it to an even size. */
function show(picture: ImageBitmap | VideoFrame, header: LiveHeader, arrival: number): void {
  const { width, height } = header.camera;
  if (pictureSize.value?.width !== width || pictureSize.value.height !== height) pictureSize.value = { width, height };
  if (canvas) {
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    canvas.getContext("2d")?.drawImage(picture, 0, 0, width, height, 0, 0, width, height);
  }
  noteFrame(header, arrival);
}

function noteFrame(header: LiveHeader, arrival: number): void {
  lastArrival = performance.now();
  lateMs.value = 0;
  meter.note(header.number, lastArrival);
  rate.value = meter.rate(lastArrival);
  frame.value = header;
  note(header, lastArrival, rate.value);
  noteDrawn(header.age_ms, arrival);
}
