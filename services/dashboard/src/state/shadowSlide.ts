// Dragging a shadow: the lamp that throws it follows.
import { ProblemError } from "../api/http";
import type { PickAnswer, Vector } from "../api/types";
import { lookAt } from "../live/pick";
import { view } from "../live/picture";
import { levelled } from "../math/bounds";
import { meetPlane, type Pixel } from "../math/camera";
import { insideBox, sourceOf, strengthAt, throwsShadows, withShadowAt, type ShadowLight } from "../math/shadow";
import { add, dot, scaled, subtract, UP } from "../math/vector";
import { boundsByObject } from "./assets";
import { Gesture } from "./gesture";
import { track } from "./pending";
import { lights, objects } from "./scene";
import { selectedLight, selectLight } from "./selection";
import type { Slide } from "./slide";
import { lightTarget } from "./targets";
import { footing, type Footing } from "./tools";

interface Shadow {
  readonly index: number;
  readonly light: ShadowLight;
  /** The point of the object that throws it. */
  readonly thrower: Vector;
  readonly surface: Footing;
}

// Thin objects' shadows are looked for from a little above the surface, which measured depth misses by some millimetres.
const ABOVE_M = 0.005;
// Nearer to the height of what throws it, the lamp would have to shine along the surface.
const LEAST_HEIGHT_M = 0.01;

/** The shadow that a point lies in: of the selected lamp, else of the one that would give most light there. */
export function shadowAt({ kind, point_m, normal }: PickAnswer): Shadow | null {
  if (kind !== "real" || !point_m || lights.value?.mode !== "manual") return null;
  const surface = { point: point_m, normal: levelled(normal ?? UP) };
  const found = lights.value.manual.flatMap((light, index): Shadow | [] => {
    const thrower = throwsShadows(light) ? throwerOf(light, surface) : null;
    return thrower && throwsShadows(light) ? { index, light, thrower, surface } : [];
  });
  const rank = ({ index, light }: Shadow): number =>
    index === selectedLight.value ? Infinity : strengthAt(light, point_m);
  return found.sort((one, other) => rank(other) - rank(one))[0] ?? null;
}

function throwerOf(light: ShadowLight, { point, normal }: Footing): Vector | null {
  const from = add(point, scaled(normal, ABOVE_M));
  for (const item of objects.value) {
    const bounds = item.visible && item.frame === "world" ? boundsByObject.value.get(item.id) : undefined;
    const thrower = bounds && insideBox(item.pose, bounds, from, sourceOf(light, from));
    if (thrower && dot(subtract(thrower, point), normal) > LEAST_HEIGHT_M) return thrower;
  }
  return null;
}

/** Begins where the pointer was pressed; slides nothing where no shadow is found. */
export class ShadowSlide implements Slide {
  private shadow: Shadow | null = null;
  private gesture: Gesture | null = null;
  private pixel: Pixel | null = null;
  private isOver = false;
  private readonly found: Promise<void>;

  constructor(pixel: Pixel) {
    this.found = this.find(pixel);
  }

  private async find(pixel: Pixel): Promise<void> {
    try {
      this.shadow = shadowAt(await lookAt(pixel));
    } catch (fault) {
      if (!(fault instanceof ProblemError)) throw fault; // a busy render server: nothing slides
    }
    if (!this.shadow || this.isOver) return;
    selectLight(this.shadow.index);
    this.gesture = new Gesture(lightTarget(this.shadow.index));
    this.place();
  }

  move(pixel: Pixel): void {
    this.pixel = pixel;
    this.place();
  }

  private place(): void {
    if (!this.shadow || !this.gesture || !this.pixel || !view.value) return;
    const { light, thrower, surface } = this.shadow;
    const point = meetPlane(view.value, this.pixel, surface.point, surface.normal);
    if (!point) return;
    footing.value = { point, normal: surface.normal };
    this.gesture.push(withShadowAt(light, thrower, point));
  }

  cancel(): void {
    this.isOver = true;
    if (this.shadow) this.gesture?.push(this.shadow.light);
    this.end();
  }

  end(): void {
    void track(this.found.then(() => this.finish()));
  }

  private async finish(): Promise<void> {
    if (this.gesture) footing.value = null;
    await this.gesture?.end();
  }
}
