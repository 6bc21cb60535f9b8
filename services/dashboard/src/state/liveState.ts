// How the live picture is doing: what is late is blamed on what the service says of it.
import { computed, effect, signal } from "@preact/signals";
import { connection, frame, lateMs } from "../live/picture";
import { isSilent, processes, readState, renderServer, renderServerName } from "./processes";
import { scene } from "./scene";
import { replay } from "./takes";

export type LiveState = "connecting" | "reconnecting" | "waiting" | "rendering" | "stale" | "no-board" | "live";

// Sooner, a slow frame is not worth a word.
const WORTH_TELLING_MS = 1000;
const TICK_MS = 250;
const STATE_INTERVAL_MS = 2000;

/** How long the oldest change that the picture does not show has been rendered, ms; 0 without. */
export const changeMs = signal(0);

export const liveState = computed<LiveState>(() => {
  if (connection.value !== "open") return frame.value === null ? "connecting" : "reconnecting";
  if (frame.value === null) return "waiting";
  if (lateMs.value > 0 && !isAtWork()) return "stale";
  if (lateMs.value > 0 || changeMs.value > WORTH_TELLING_MS) return "rendering";
  return frame.value.status === "ok" ? "live" : "no-board";
});

/** Whether the picture is of a time that is over. */
export const isOutdated = computed(() => liveState.value === "stale" || liveState.value === "reconnecting");

/** Whether frames come to a renderer that answers: then it is only slow. */
function isAtWork(): boolean {
  return renderServer.value !== "silent" && isSending();
}

/** Whether a camera or a recording sends frames. */
export function isSending(): boolean {
  if (replay.value?.recording != null) return true;
  return [...processes.value.values()].some(
    (seen) => seen.report.name !== renderServerName.value && (seen.report.rates.fps ?? 0) > 0 && !isSilent(seen),
  );
}

interface Awaited {
  readonly revision: number;
  readonly sinceMs: number;
}

/** What is awaited after the picture or the scene became another. */
export function awaitedChange(
  before: Awaited | null,
  shown: { readonly id: string; readonly revision: number } | null,
  current: { readonly id: string; readonly revision: number } | null,
  nowMs: number,
): Awaited | null {
  if (!shown || !current || (shown.id === current.id && shown.revision >= current.revision)) return null;
  const isBeforeShown = before !== null && shown.id === current.id && shown.revision >= before.revision;
  return before === null || isBeforeShown ? { revision: current.revision, sinceMs: nowMs } : before;
}

let awaited: Awaited | null = null;
let lastRead = -Infinity;

export function followChanges(): void {
  effect(() => {
    const current = scene.value?.picture?.state === "refused" ? null : scene.value;
    awaited = awaitedChange(awaited, frame.value?.scene ?? null, current, performance.now());
    if (!awaited) changeMs.value = 0;
  });
  setInterval(tick, TICK_MS);
}

function tick(): void {
  const now = performance.now();
  changeMs.value = awaited ? now - awaited.sinceMs : 0;
  if (lateMs.value > 0 && now - lastRead > STATE_INTERVAL_MS) {
    lastRead = now;
    void readState();
  }
}
