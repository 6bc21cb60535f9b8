import { effect, useSignal, type Signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { API, ProblemError, requestBytes } from "../../api/http";
import { view } from "../../live/picture";
import type { Room } from "../../room/room";
import { assets, boundsByObject } from "../../state/assets";
import { lights, objects } from "../../state/scene";
import { Button } from "../ui/Button";

const GLB = "glb";

/** The room from anywhere: dragged about, zoomed by the wheel or two fingers, or turned by keys. */
export function RoomView() {
  const area = useRef<HTMLDivElement>(null);
  const canvas = useRef<HTMLCanvasElement>(null);
  const room = useRef<Room | null>(null);
  const notice = useSignal("Reading the room…");
  useEffect(() => {
    if (!canvas.current || !area.current) return;
    return openRoom(canvas.current, area.current, room, notice);
  }, []);
  const onKeyDown = (event: KeyboardEvent): void => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (room.current?.press(event.key)) event.preventDefault();
  };
  const lookFromCamera = (): void => {
    if (view.value) room.current?.lookFrom(view.value);
  };
  return (
    <div class="picture-area" ref={area}>
      <canvas
        class="layer surface room"
        ref={canvas}
        id="stage"
        role="application"
        aria-label="Room in 3-D: drag or use the arrow keys to orbit, plus and minus to zoom"
        tabIndex={0}
        data-shown={notice.value === ""}
        onKeyDown={onKeyDown}
      />
      {notice.value && (
        <p class="drop-hint" role="status">
          {notice.value}
        </p>
      )}
      <div class="room-bar">
        <Button onClick={lookFromCamera}>Look from the camera</Button>
        <Button onClick={() => room.current && void readSurfaces(room.current, notice)}>Update the room</Button>
      </div>
    </div>
  );
}

/** Load three, and keep the room up to date until the returned function is called. */
function openRoom(
  canvas: HTMLCanvasElement,
  area: HTMLElement,
  room: { current: Room | null },
  notice: Signal<string>,
): () => void {
  let close: (() => void) | null = null;
  let isGone = false;
  void load(canvas).then((loaded) => {
    if (!loaded) notice.value = "The room in 3-D needs WebGL, which this browser does not have.";
    else if (isGone) loaded.dispose();
    else {
      room.current = loaded;
      close = follow(loaded, area, notice);
    }
  });
  return () => {
    isGone = true;
    room.current = null;
    close?.();
  };
}

async function load(canvas: HTMLCanvasElement): Promise<Room | null> {
  const { Room: Loaded } = await import("../../room/room");
  try {
    return new Loaded(canvas, readAsset);
  } catch {
    return null;
  }
}

function follow(room: Room, area: HTMLElement, notice: Signal<string>): () => void {
  const sizes = new ResizeObserver(([entry]) => {
    if (entry) room.setSize(entry.contentRect.width, entry.contentRect.height);
  });
  sizes.observe(area);
  const ends = [
    effect(() => void room.setObjects(objects.value, boundsByObject.value)),
    effect(() => room.setMarks(lights.value, view.value)),
  ];
  void readSurfaces(room, notice).then(() => view.value && room.lookFrom(view.value));
  return () => {
    sizes.disconnect();
    ends.forEach((end) => end());
    room.dispose();
  };
}

async function readSurfaces(room: Room, notice: Signal<string>): Promise<void> {
  try {
    await room.setSurfaces(await requestBytes(`${API}/live/room.glb`));
    notice.value = "";
  } catch (fault) {
    if (!(fault instanceof ProblemError)) throw fault;
    notice.value = fault.message;
  }
}

async function readAsset(name: string): Promise<ArrayBuffer | null> {
  const asset = assets.peek().find((each) => each.asset === name);
  return asset?.format === GLB ? requestBytes(`${API}/assets/${name}/content`) : null;
}
