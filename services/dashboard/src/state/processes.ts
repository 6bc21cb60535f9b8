// Nodes and render server, as they report themselves.
import { signal } from "@preact/signals";
import { API, request } from "../api/http";
import type { Fisheye, ProcessAnswer, State } from "../api/types";

export interface Seen {
  readonly report: ProcessAnswer;
  readonly arrivedMs: number;
}

export const processes = signal<ReadonlyMap<string, Seen>>(new Map());
export const renderServer = signal<"answers" | "silent" | null>(null);
export const fisheye = signal<Fisheye | null>(null);

export function takeReport(report: ProcessAnswer): void {
  processes.value = new Map(processes.value).set(report.name, { report, arrivedMs: performance.now() });
}

/** The state of everything; failures are told by the events' connection already. */
export async function readState(): Promise<void> {
  try {
    const state = await request<State>("GET", `${API}/state`);
    renderServer.value = state.render_server;
    for (const report of state.processes) takeReport(report);
  } catch {
    renderServer.value = null;
  }
}

/** The lights that the fish-eye picture holds; none where no such camera is. */
export async function readFisheye(): Promise<void> {
  try {
    fisheye.value = await request<Fisheye>("GET", `${API}/fisheye`);
  } catch {
    fisheye.value = null;
  }
}
