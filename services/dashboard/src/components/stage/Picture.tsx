import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { role } from "../../api/session";
import { showPictureOn } from "../../live/picture";
import { ASSET_DRAG, droppedAsset } from "../../state/drag";
import { addObject } from "../../state/actions";
import { upload } from "../../state/assets";
import { isOutdated } from "../../state/liveState";
import { nudge } from "../../state/nudge";
import { selectedObjectId } from "../../state/selection";
import { isRecording, openRecording } from "../../state/takes";
import { tool } from "../../state/tools";
import { CompareSlider } from "./CompareSlider";
import { usePictureBox } from "./fit";
import { Outlines } from "./Outlines";
import { isOnLamp, PicturePointer } from "./pointer";
import { PictureNotice } from "./PictureNotice";
import { Poster } from "./Poster";
import { ShadowHint } from "./ShadowHint";
import { stepSelection } from "./stepSelection";
import { useGizmo } from "./useGizmo";

/** The live picture with everything that lies over it. */
export function Picture() {
  const area = useRef<HTMLDivElement>(null);
  const surface = useRef<HTMLDivElement>(null);
  const picture = useRef<HTMLCanvasElement>(null);
  const handles = useRef<HTMLCanvasElement>(null);
  const pointer = useRef<PicturePointer | null>(null);
  const isDropping = useSignal(false);
  const box = usePictureBox(area);
  const gizmo = useGizmo(handles, surface, box);

  useEffect(() => {
    showPictureOn(picture.current);
    if (surface.current) pointer.current = new PicturePointer(surface.current, () => gizmo.current);
    return () => showPictureOn(null);
  }, []);

  const onKeyDown = (event: KeyboardEvent): void => {
    if (event.ctrlKey || event.metaKey) return;
    const done = event.key === "Escape" ? cancel() : stepSelection(event) || (role.value === "control" && nudge(event));
    if (done) event.preventDefault();
  };
  const cancel = (): boolean => gizmo.current?.cancel() === true || pointer.current?.cancel() === true;
  const onDrop = (event: DragEvent): void => {
    event.preventDefault();
    isDropping.value = false;
    const pixel = pointer.current?.pixelOf(event);
    if (pixel && role.value === "control") void dropAt(event, pixel);
  };
  const { left, top, width, height } = box.value;
  const style = { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` };
  return (
    <div class="picture-area" ref={area}>
      <div
        class={`picture ${isDropping.value ? "dropping" : ""} ${isOutdated.value ? "not-live" : ""}`}
        style={style}
        onDragOver={(event) => {
          event.preventDefault();
          isDropping.value = role.value === "control";
        }}
        onDragLeave={() => (isDropping.value = false)}
        onDrop={onDrop}
      >
        <canvas class="layer" ref={picture} role="img" aria-label="Live picture" />
        <Poster />
        <Outlines box={box} />
        <canvas class="layer" ref={handles} aria-hidden="true" />
        <div
          class={`layer surface ${isAiming() ? "placing" : isOnLamp.value ? "on-lamp" : ""}`}
          ref={surface}
          id="stage"
          role="application"
          aria-label="Picture: click selects; arrow keys move the selection"
          tabIndex={0}
          onPointerDown={(event) => pointer.current?.down(event)}
          onPointerMove={(event) => pointer.current?.move(event)}
          onPointerUp={(event) => pointer.current?.up(event)}
          onPointerCancel={() => pointer.current?.cancel()}
          onPointerLeave={() => pointer.current?.leave()}
          onKeyDown={onKeyDown}
        />
        <CompareSlider />
        <PictureNotice />
        <ShadowHint />
        {isDropping.value && <p class="drop-hint">Drop an object where it should stand, or drop a recording</p>}
      </div>
    </div>
  );
}

/** Whether the next click chooses a place. */
function isAiming(): boolean {
  return tool.value === "shadow" || (tool.value === "place" && selectedObjectId.value !== null);
}

async function dropAt(event: DragEvent, pixel: readonly [number, number]): Promise<void> {
  const dragged = droppedAsset(event.dataTransfer?.getData(ASSET_DRAG));
  if (dragged) return addObject(dragged, pixel);
  for (const file of [...(event.dataTransfer?.files ?? [])]) {
    if (await isRecording(file)) {
      await openRecording(file);
      continue;
    }
    const asset = await upload(file);
    if (asset?.kind === "mesh") await addObject(asset, pixel, file.name);
  }
}
