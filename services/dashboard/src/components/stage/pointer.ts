// The pointer on the picture: click selects, dragging the selected object or a lamp slides it over the ground.
import { signal } from "@preact/signals";
import { role } from "../../api/session";
import type { Pose, Vector } from "../../api/types";
import { pictureSize, view } from "../../live/picture";
import { meetPlane, type Pixel } from "../../math/camera";
import { snap, SNAP_M } from "../../math/snap";
import { add, subtract, UP } from "../../math/vector";
import { pick, placeObject } from "../../state/actions";
import { handle, HandleDrag } from "../../state/handle";
import { selectedLight, selectedObjectId, selectLight, selectObject } from "../../state/selection";
import { isSnapping, tool } from "../../state/tools";
import { lampAt, objectsAt } from "./hits";

const CLICK_PX = 4;

/** The object under the pointer. */
export const hovered = signal<string | null>(null);

interface Press {
  readonly x: number;
  readonly y: number;
  readonly slides: boolean;
  slide: Slide | null;
}

/** Sliding over the horizontal plane through what is held. */
class Slide {
  private readonly drag: HandleDrag;
  private readonly from: Vector;

  constructor(
    private readonly pose: Pose,
    from: Vector,
    drag: HandleDrag,
  ) {
    this.from = from;
    this.drag = drag;
  }

  static begin(pixel: Pixel): Slide | null {
    const held = handle.value;
    const from = held && view.value && meetPlane(view.value, pixel, held.pose.translation_m, UP);
    return held && from ? new Slide(held.pose, from, new HandleDrag(held)) : null;
  }

  move(pixel: Pixel, snaps: boolean): void {
    const to = view.value && meetPlane(view.value, pixel, this.pose.translation_m, UP);
    if (!to) return;
    const [x, y, z] = add(this.pose.translation_m, subtract(to, this.from));
    this.drag.move({ ...this.pose, translation_m: snaps ? [snap(x, SNAP_M), snap(y, SNAP_M), z] : [x, y, z] });
  }

  cancel(): void {
    this.drag.move(this.pose);
    this.end();
  }

  end(): void {
    void this.drag.end();
  }
}

export class PicturePointer {
  private press: Press | null = null;

  constructor(
    private readonly surface: HTMLElement,
    private readonly isOnGizmo: () => boolean,
  ) {}

  down(event: PointerEvent): void {
    if (event.button !== 0 || this.isOnGizmo()) return;
    const [x, y] = this.place(event);
    this.press = { x, y, slides: this.grabs([x, y]), slide: null };
  }

  move(event: PointerEvent): void {
    const at = this.place(event);
    const press = this.press;
    if (!press) {
      hovered.value = view.value && !this.isOnGizmo() ? (objectsAt(view.value, this.pixel(at))[0] ?? null) : null;
      return;
    }
    if (!press.slide && press.slides && Math.hypot(at[0] - press.x, at[1] - press.y) > CLICK_PX) {
      press.slide = Slide.begin(this.pixel([press.x, press.y]));
      this.surface.setPointerCapture(event.pointerId);
    }
    press.slide?.move(this.pixel(at), event.shiftKey !== isSnapping.value);
  }

  up(event: PointerEvent): void {
    const press = this.press;
    this.press = null;
    if (press?.slide) press.slide.end();
    else if (press && this.moved(press, event) <= CLICK_PX) void this.click([press.x, press.y]);
  }

  leave(): void {
    if (!this.press) hovered.value = null;
  }

  /** Put back what slides; false where nothing does. */
  cancel(): boolean {
    const slide = this.press?.slide ?? null;
    this.press = null;
    slide?.cancel();
    return slide !== null;
  }

  /** A pixel of the picture at a place of a mouse or drop event. */
  pixelOf(event: MouseEvent): Pixel {
    return this.pixel(this.place(event));
  }

  private moved(press: Press, event: PointerEvent): number {
    const [x, y] = this.place(event);
    return Math.hypot(x - press.x, y - press.y);
  }

  /** Whether a press here holds the selection, so that moving the pointer slides it. */
  private grabs(at: Pixel): boolean {
    if (role.value !== "control" || tool.value === "place" || !view.value) return false;
    const lamp = lampAt(this.sheet(), at);
    if (lamp !== null) return lamp === selectedLight.value;
    return selectedObjectId.value !== null && objectsAt(view.value, this.pixel(at)).includes(selectedObjectId.value);
  }

  private async click(at: Pixel): Promise<void> {
    const pixel = this.pixel(at);
    const held = selectedObjectId.value;
    if (tool.value === "place" && held !== null && role.value === "control") {
      await placeObject(held, pixel);
      return;
    }
    const lamp = view.value ? lampAt(this.sheet(), at) : null;
    if (lamp !== null) selectLight(lamp);
    else await this.select(pixel);
  }

  private async select(pixel: Pixel): Promise<void> {
    const found = await pick(pixel);
    if (found) selectObject(found.kind === "object" ? found.object : null);
  }

  private place(event: MouseEvent): Pixel {
    const outline = this.surface.getBoundingClientRect();
    return [event.clientX - outline.left, event.clientY - outline.top];
  }

  private sheet() {
    const { width, height } = this.surface.getBoundingClientRect();
    return { view: view.value!, factor: width / (pictureSize.value?.width ?? width), width, height };
  }

  private pixel([x, y]: Pixel): Pixel {
    const factor = (pictureSize.value?.width ?? 1) / this.surface.getBoundingClientRect().width;
    return [x * factor - 0.5, y * factor - 0.5];
  }
}
