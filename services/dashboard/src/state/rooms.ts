// The rooms of this installation: which there are, how they are doing, and where they run.
import { computed, signal } from "@preact/signals";
import { apiOf, request, ROOT } from "../api/http";
import { pageOf, room } from "../api/room";
import type { RoomAnswer, RoomsAnswer } from "../api/types";
import { renderServerName } from "./processes";
import { toast } from "./toasts";

export const rooms = signal<RoomsAnswer | null>(null);
export const areRoomsShown = signal(false);
/** The room that this page shows. */
export const shownRoom = computed(() => {
  const all = rooms.value?.rooms ?? [];
  return all.find((each) => each.name === room) ?? all[0] ?? null;
});
/** Whether there is a choice. */
export const hasRooms = computed(() => (rooms.value?.rooms.length ?? 0) > 1);

export async function readRooms(): Promise<void> {
  const isFirst = rooms.value === null;
  try {
    rooms.value = await request<RoomsAnswer>("GET", `${ROOT}/rooms`);
  } catch {
    return; // the events' connection tells that the service is away
  }
  if (rooms.value.can_move && shownRoom.value) renderServerName.value = shownRoom.value.name;
  if (isFirst && hasRooms.value && room === null) areRoomsShown.value = true;
}

export function openRoom(name: string): void {
  location.assign(pageOf(name));
}

/** Slots that a room could move to. */
export function freeSlots(): readonly string[] {
  return (rooms.value?.slots ?? []).filter((slot) => slot.room == null && !slot.drained).map((slot) => slot.name);
}

/** The hosts of all slots, each with its rooms. */
export const hosts = computed(() => {
  const slots = rooms.value?.slots ?? [];
  return [...new Set(slots.map((slot) => slot.host))].map((name) => {
    const own = slots.filter((slot) => slot.host === name);
    return {
      name,
      drained: own.some((slot) => slot.drained),
      slots: own.length,
      rooms: own.flatMap((slot) => slot.room ?? []),
    };
  });
});
export const drainHost = (name: string): Promise<void> => command("POST", `${ROOT}/hosts/${name}/drain`);
export const undrainHost = (name: string): Promise<void> => command("DELETE", `${ROOT}/hosts/${name}/drain`);

export const drainRoom = ({ name }: RoomAnswer): Promise<void> => order(name, "drain");
export const startRoom = ({ name }: RoomAnswer): Promise<void> => order(name, "start");
export const moveRoom = ({ name }: RoomAnswer, slot: string): Promise<void> => order(name, "move", { slot });

const order = (name: string, what: string, body?: unknown): Promise<void> =>
  command("POST", `${apiOf(name)}/${what}`, body);

async function command(method: "POST" | "DELETE", path: string, body?: unknown): Promise<void> {
  try {
    await request(method, path, { body });
  } catch (fault) {
    toast(fault instanceof Error ? fault.message : String(fault), "error");
  }
  await readRooms();
}
