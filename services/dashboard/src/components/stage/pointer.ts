// The pointer on the picture: a click selects, dragging slides the selected object or lamp, or a shadow.
import { signal } from "@preact/signals";
import { role } from "../../api/session";
import type { Gizmo } from "../../gizmo/gizmo";
import { pictureSize, view } from "../../live/picture";
import type { Pixel } from "../../math/camera";
import { placeObject } from "../../state/actions";
import { pick } from "../../state/placing";
import { takeShadowClick } from "../../state/shadowLight";
import { ShadowSlide } from "../../state/shadowSlide";
import { beginBorderSlide, beginSlide, slidesOnSurfaces, type Slide } from "../../state/slide";
import { selectedObjectId, selectLight, selectObject } from "../../state/selection";
import { isSnapping, tool, type Tool } from "../../state/tools";
import { lampAt, objectsAt } from "./hits";
import type { LampMark } from "./outlines";

// A press that moves less is a click; a finger rolls where a mouse stands still.
const CLICK_PX = { mouse: 4, touch: 10 };

/** The object under the pointer. */
export const hovered = signal<string | null>(null);
/** Whether the sign of a lamp is under the pointer. */
export const isOnLamp = signal(false);

interface Press {
  readonly x: number;
  readonly y: number;
  /** Begins what moving the pointer slides; null where that is nothing. */
  readonly begin: ((pixel: Pixel) => Slide | null) | null;
  /** On a handle of the gizmo, where a click means nothing. */
  readonly isOnHandle: boolean;
  slide: Slide | null;
}

export class PicturePointer {
  private press: Press | null = null;

  constructor(
    private readonly surface: HTMLElement,
    private readonly gizmo: () => Gizmo | null,
  ) {}

  down(event: PointerEvent): void {
    if (event.button !== 0 || !event.isPrimary) return;
    const [x, y] = this.place(event);
    const grip = this.gizmo()?.gripAt(event) ?? null;
    if (grip === null) this.press = { x, y, begin: this.takes([x, y]), isOnHandle: false, slide: null };
    else if (grip === "free" && slidesOnSurfaces()) {
      this.gizmo()?.pause(true); // its own drag would leave the surfaces
      this.press = { x, y, begin: beginSlide, isOnHandle: true, slide: null };
    }
  }

  move(event: PointerEvent): void {
    if (!event.isPrimary) return;
    const at = this.place(event);
    const press = this.press;
    if (!press) {
      this.hover(at);
      return;
    }
    if (!press.slide && press.begin && !isClick(press, at, event)) {
      press.slide = press.begin(this.pixel([press.x, press.y]));
      this.surface.setPointerCapture(event.pointerId);
    }
    press.slide?.move(this.pixel(at), event.shiftKey !== isSnapping.value);
  }

  up(event: PointerEvent): void {
    if (!event.isPrimary) return;
    const press = this.release();
    if (press?.slide) press.slide.end();
    else if (press && !press.isOnHandle && isClick(press, this.place(event), event))
      void this.click([press.x, press.y]);
  }

  leave(): void {
    if (this.press) return;
    hovered.value = null;
    isOnLamp.value = false;
  }

  private hover(at: Pixel): void {
    const seen = this.gizmo()?.isTouched === true ? null : view.value;
    isOnLamp.value = seen !== null && lampAt(this.sheet(), at) !== null;
    hovered.value = seen && (objectsAt(seen, this.pixel(at))[0] ?? null);
  }

  /** Put back what slides; false where nothing does. */
  cancel(): boolean {
    const slide = this.release()?.slide ?? null;
    slide?.cancel();
    return slide !== null;
  }

  private release(): Press | null {
    const press = this.press;
    this.press = null;
    this.gizmo()?.pause(false);
    return press;
  }

  /** A pixel of the picture at a place of a mouse or drop event. */
  pixelOf(event: MouseEvent): Pixel {
    return this.pixel(this.place(event));
  }

  /** What a press here holds: a lamp, the selection, or else the shadow that may be there. */
  private takes(at: Pixel): Press["begin"] {
    if (role.value !== "control" || isClicking(tool.value) || !view.value) return null;
    const lamp = lampAt(this.sheet(), at);
    if (lamp !== null) return (pixel) => takeLamp(lamp, pixel);
    const held = selectedObjectId.value;
    if (held !== null && objectsAt(view.value, this.pixel(at)).includes(held)) return beginSlide;
    return (pixel) => new ShadowSlide(pixel);
  }

  private async click(at: Pixel): Promise<void> {
    const pixel = this.pixel(at);
    const held = selectedObjectId.value;
    if (tool.value === "shadow") {
      await takeShadowClick(pixel);
      return;
    }
    if (tool.value === "place" && held !== null && role.value === "control") {
      await placeObject(held, pixel);
      return;
    }
    const lamp = view.value ? lampAt(this.sheet(), at) : null;
    if (lamp !== null) selectLight(lamp.index);
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

function takeLamp({ index, isOutside }: LampMark, pixel: Pixel): Slide | null {
  selectLight(index);
  return isOutside ? beginBorderSlide(pixel) : beginSlide(pixel);
}

/** Whether a tool takes clicks and nothing else. */
function isClicking(inHand: Tool): boolean {
  return inHand === "place" || inHand === "shadow";
}

function isClick(press: Press, [x, y]: Pixel, { pointerType }: PointerEvent): boolean {
  return Math.hypot(x - press.x, y - press.y) <= (pointerType === "touch" ? CLICK_PX.touch : CLICK_PX.mouse);
}
