import { useSignalEffect, type ReadonlySignal } from "@preact/signals";
import type { RefObject } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { role } from "../../api/session";
import type { Gizmo, GizmoMode } from "../../gizmo/gizmo";
import { view } from "../../live/picture";
import { handle, HandleDrag } from "../../state/handle";
import { areOutlinesShown, isSnapping, tool, type Tool } from "../../state/tools";
import { toast } from "../../state/toasts";
import type { Box } from "./fit";

const MODES: Partial<Record<Tool, GizmoMode>> = { move: "translate", rotate: "rotate", scale: "scale" };

/** The gizmo on a canvas; loaded when the page has time, and left out where there is no WebGL. */
export function useGizmo(
  canvas: RefObject<HTMLCanvasElement | null>,
  surface: RefObject<HTMLElement | null>,
  box: ReadonlySignal<Box>,
): RefObject<Gizmo | null> {
  const gizmo = useRef<Gizmo | null>(null);
  const update = (): void => {
    const held = handle.value;
    const mode = MODES[tool.value];
    const isShown = areOutlinesShown.value && role.value === "control" && mode && held?.tools.includes(tool.value);
    gizmo.current?.setView(view.value);
    gizmo.current?.setSize(box.value.width, box.value.height);
    gizmo.current?.hold(isShown ? (held?.pose ?? null) : null, mode ?? "translate");
  };
  useEffect(() => {
    let isGone = false;
    void load(canvas.current, surface.current).then((loaded) => {
      if (isGone) return loaded?.dispose();
      gizmo.current = loaded;
      update();
    });
    return () => {
      isGone = true;
      gizmo.current?.dispose();
      gizmo.current = null;
    };
  }, []);
  useSignalEffect(update);
  useShiftSnapping(gizmo);
  return gizmo;
}

async function load(canvas: HTMLCanvasElement | null, surface: HTMLElement | null): Promise<Gizmo | null> {
  if (!canvas || !surface) return null;
  let drag: HandleDrag | null = null;
  const { Gizmo: Loaded } = await import("../../gizmo/gizmo");
  try {
    return new Loaded(canvas, surface, {
      onStart: () => (drag = handle.value && new HandleDrag(handle.value)),
      onMove: (pose) => drag?.move(pose),
      onEnd: () => {
        void drag?.end();
        drag = null;
      },
    });
  } catch {
    toast(
      "This browser has no WebGL, so the picture has no handles. Drag the objects themselves, or use the arrow keys or the fields.",
    );
    return null;
  }
}

function useShiftSnapping(gizmo: RefObject<Gizmo | null>): void {
  useEffect(() => {
    const follow = (event: KeyboardEvent): void => gizmo.current?.setSnapping(event.shiftKey !== isSnapping.value);
    document.addEventListener("keydown", follow);
    document.addEventListener("keyup", follow);
    return () => {
      document.removeEventListener("keydown", follow);
      document.removeEventListener("keyup", follow);
    };
  }, []);
  useSignalEffect(() => gizmo.current?.setSnapping(isSnapping.value));
}
