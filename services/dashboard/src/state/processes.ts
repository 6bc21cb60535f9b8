// Nodes and render server, as they report themselves.
import { signal } from "@preact/signals";
import { API, request } from "../api/http";
import type { Fisheye, ProcessAnswer, State } from "../api/types";
import { cameras } from "./cameras";

export interface Seen {
  readonly report: ProcessAnswer;
  readonly arrivedMs: number;
}

/** The render server's name among the processes; that of a room bears the room's. */
export const renderServerName = signal("render-server");
/** That of the node that replays a recording. */
export const REPLAY = "replay";
// Processes report once a second; so many misses are no accident.
const SILENT_MS = 5000;

export const processes = signal<ReadonlyMap<string, Seen>>(new Map());
export const renderServer = signal<"answers" | "silent" | null>(null);
export const fisheye = signal<Fisheye | null>(null);
/** Whether a fish-eye camera sends light; null until the service told. */
export const hasFisheye = signal<boolean | null>(null);

/** Whether a process has stopped reporting; the renderer reports between frames only, and answers meanwhile. */
export function isSilent({ report, arrivedMs }: Seen): boolean {
  if (report.name === renderServerName.value && renderServer.value === "answers") return false;
  return performance.now() - arrivedMs > SILENT_MS;
}

export function takeReport(report: ProcessAnswer): void {
  processes.value = new Map(processes.value).set(report.name, {
    report,
    arrivedMs: performance.now() - 1000 * report.age_s,
  });
}

/** The state of everything; failures are told by the events' connection already. */
export async function readState(): Promise<void> {
  try {
    const state = await request<State>("GET", `${API}/state`);
    renderServer.value = state.render_server;
    hasFisheye.value = state.has_fisheye;
    cameras.value = state.cameras;
    for (const report of state.processes) takeReport(report);
  } catch {
    renderServer.value = null;
  }
}

/** The lights that the fish-eye picture holds; none where no such camera is. */
export async function readFisheye(): Promise<void> {
  await readState();
  if (hasFisheye.value !== true) {
    fisheye.value = null;
    return;
  }
  try {
    fisheye.value = await request<Fisheye>("GET", `${API}/fisheye`);
  } catch {
    fisheye.value = null;
  }
}
