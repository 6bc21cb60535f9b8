import { useEffect } from "preact/hooks";
import { apiOf } from "../../api/http";
import { role } from "../../api/session";
import type { RoomAnswer } from "../../api/types";
import { rateText } from "../../math/units";
import {
  areRoomsShown,
  drainHost,
  drainRoom,
  freeSlots,
  hosts,
  moveRoom,
  openRoom,
  readRooms,
  rooms,
  shownRoom,
  startRoom,
  undrainHost,
} from "../../state/rooms";
import { Dialog } from "../ui/Dialog";
import { Icon } from "../ui/Icon";
import { LiveThumbnail } from "../ui/LiveThumbnail";
import { Menu, type MenuEntry } from "../ui/Menu";
import { Sentence } from "../ui/Sentence";

const PERIOD_MS = 2000; // of rates; changes of state come as events

/** All rooms with their live pictures, how they are doing, and why one waits. */
export function RoomsDialog() {
  return areRoomsShown.value ? <Rooms /> : null;
}

function Rooms() {
  useEffect(() => {
    const timer = setInterval(() => void readRooms(), PERIOD_MS);
    return () => clearInterval(timer);
  }, []);
  return (
    <Dialog title="Rooms" onClose={() => (areRoomsShown.value = false)}>
      <ul class="rooms">
        {rooms.value?.rooms.map((room) => (
          <li key={room.name}>
            <RoomCard room={room} />
          </li>
        ))}
      </ul>
      {hosts.value.length > 1 && (
        <ul class="hosts" aria-label="Hosts">
          {hosts.value.map((host) => (
            <li key={host.name} class="spread">
              <span class="cut">{host.name}</span>
              <span class="quiet small">
                {host.rooms.length} of {host.slots} slots in use
              </span>
              {host.drained && <span class="badge waiting">drained</span>}
              {role.value === "control" && (
                <button
                  type="button"
                  class="button"
                  onClick={() => void (host.drained ? undrainHost : drainHost)(host.name)}
                >
                  {host.drained ? "Accept rooms" : "Drain"}
                </button>
              )}
            </li>
          ))}
        </ul>
      )}
    </Dialog>
  );
}

function RoomCard({ room }: { readonly room: RoomAnswer }) {
  const isShown = shownRoom.value?.name === room.name;
  const entries = entriesOf(room);
  return (
    <article class={`card room ${isShown ? "current" : ""}`} aria-label={room.title}>
      <button type="button" class="room-picture" aria-label={`Open ${room.title}`} onClick={() => openRoom(room.name)}>
        {room.state === "running" ? (
          <LiveThumbnail path={`${apiOf(room.name)}/live.jpg`} alt="" />
        ) : (
          <span class="no-image" />
        )}
      </button>
      <div class="spread">
        <h3 class="cut">{room.title}</h3>
        <span class={`badge ${room.state === "failed" ? "bad" : room.state}`}>{room.state}</span>
      </div>
      <p class="quiet small">{factsOf(room)}</p>
      {room.why && (
        <p class="small">
          <Sentence text={room.why} />
        </p>
      )}
      {entries.length > 0 && (
        <Menu label={`Where ${room.title} runs`} entries={entries}>
          <Icon name="node" /> {room.moving_to ? `moving to ${room.moving_to}` : (room.slot ?? "not running")}
        </Menu>
      )}
    </article>
  );
}

function factsOf(room: RoomAnswer): string {
  const facts = [room.nodes.join(", "), room.scene?.method];
  if (room.state === "running") facts.push(rateText(room.frames_per_s));
  if (room.restarts > 0) facts.push(room.restarts === 1 ? "restarted once" : `restarted ${room.restarts} times`);
  return facts.filter(Boolean).join(" · ");
}

function entriesOf(room: RoomAnswer): readonly MenuEntry[] {
  if (rooms.value?.can_move !== true || role.value !== "control") return [];
  if (room.slot == null) return [{ label: "Start", icon: "play", onClick: () => startRoom(room) }];
  const isBound = room.state !== "running" || room.moving_to != null;
  const moves = freeSlots().map((slot): MenuEntry => ({
    label: `Move to ${slot}`,
    icon: "right",
    disabled: isBound,
    onClick: () => moveRoom(room, slot),
  }));
  return [...moves, { label: "Drain", icon: "pause", begins: moves.length > 0, onClick: () => drainRoom(room) }];
}
