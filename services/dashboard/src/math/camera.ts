// A frame's own camera (docs/conventions.md): optical axes, pixel centres at integers, OpenCV's lens models.
import type { LiveCamera, Vector } from "../api/types";
import { dot, subtract } from "./vector";

export type Matrix4 = readonly (readonly [number, number, number, number])[];
export type Pixel = readonly [number, number];

export interface Lens {
  readonly width: number;
  readonly height: number;
  readonly fx: number;
  readonly fy: number;
  readonly cx: number;
  readonly cy: number;
  readonly model: "plumb_bob" | "equidistant";
  readonly coefficients: readonly number[];
}

/** A lens somewhere in the world. */
export interface View {
  readonly lens: Lens;
  readonly worldFromCamera: Matrix4;
}

// Newton's method on smooth lenses ends far below a pixel after so many rounds.
const UNPROJECT_ROUNDS = 20;

export function lensOf(camera: LiveCamera): Lens {
  const at = (index: number): number => camera.matrix[index] ?? 0;
  return {
    width: camera.width,
    height: camera.height,
    fx: at(0),
    cx: at(2),
    fy: at(4),
    cy: at(5),
    model: camera.distortion_model,
    coefficients: camera.distortion,
  };
}

export function cameraFromWorld(view: View, point: Vector): Vector {
  const m = view.worldFromCamera;
  const offset = subtract(point, eyeOf(view));
  return [dot(column(m, 0), offset), dot(column(m, 1), offset), dot(column(m, 2), offset)];
}

export function eyeOf(view: View): Vector {
  return column(view.worldFromCamera, 3);
}

export function column(m: Matrix4, index: number): Vector {
  return [entry(m, 0, index), entry(m, 1, index), entry(m, 2, index)];
}

function entry(m: Matrix4, row: number, index: number): number {
  return m[row]?.[index] ?? 0;
}

/** Pixel of a point in the world; null behind the camera. */
export function project(view: View, point: Vector): Pixel | null {
  const [x, y, z] = cameraFromWorld(view, point);
  return z > 1e-6 ? pixelOf(view.lens, x / z, y / z) : null;
}

export function isInPicture({ width, height }: Lens, [x, y]: Pixel): boolean {
  return x >= 0 && y >= 0 && x < width && y < height;
}

/** The same without the lens: what a pinhole camera of these intrinsics shows. */
export function projectPinhole(view: View, point: Vector): Pixel | null {
  const [x, y, z] = cameraFromWorld(view, point);
  const { fx, fy, cx, cy } = view.lens;
  return z > 1e-6 ? [(fx * x) / z + cx, (fy * y) / z + cy] : null;
}

export function pixelOf(lens: Lens, x: number, y: number): Pixel {
  const [u, v] = lens.model === "equidistant" ? equidistant(lens, x, y) : plumbBob(lens, x, y);
  return [lens.fx * u + lens.cx, lens.fy * v + lens.cy];
}

function plumbBob(lens: Lens, x: number, y: number): Pixel {
  const [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0] =
    lens.coefficients;
  const r2 = x * x + y * y;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [
    x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
    y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
  ];
}

function equidistant(lens: Lens, x: number, y: number): Pixel {
  const [k1 = 0, k2 = 0, k3 = 0, k4 = 0] = lens.coefficients;
  const r = Math.hypot(x, y);
  if (r < 1e-9) return [x, y];
  const t = Math.atan(r);
  const t2 = t * t;
  const factor = (t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))) / r;
  return [x * factor, y * factor];
}

/** (x/z, y/z) of the ray through a pixel: Newton's method on the lens model. */
export function unproject(lens: Lens, [u, v]: Pixel): Pixel {
  let x = (u - lens.cx) / lens.fx;
  let y = (v - lens.cy) / lens.fy;
  if (!isDistorted(lens)) return [x, y];
  const step = 1e-5;
  for (let round = 0; round < UNPROJECT_ROUNDS; round++) {
    const [pu, pv] = pixelOf(lens, x, y);
    const [au, av] = pixelOf(lens, x + step, y);
    const [bu, bv] = pixelOf(lens, x, y + step);
    const [a, c, b, d] = [(au - pu) / step, (av - pv) / step, (bu - pu) / step, (bv - pv) / step];
    const determinant = a * d - b * c;
    if (Math.abs(determinant) < 1e-12) break;
    const [eu, ev] = [u - pu, v - pv];
    x += (d * eu - b * ev) / determinant;
    y += (a * ev - c * eu) / determinant;
    if (Math.hypot(eu, ev) < 1e-6) break;
  }
  return [x, y];
}

export function isDistorted(lens: Lens): boolean {
  return lens.model === "equidistant" || lens.coefficients.some((value) => value !== 0);
}

/** Direction (not of length 1) of the ray through a pixel, in the world. */
export function rayThrough(view: View, pixel: Pixel): Vector {
  const [x, y] = unproject(view.lens, pixel);
  const m = view.worldFromCamera;
  const [a, b, c] = [column(m, 0), column(m, 1), column(m, 2)];
  return [a[0] * x + b[0] * y + c[0], a[1] * x + b[1] * y + c[1], a[2] * x + b[2] * y + c[2]];
}

/** Where the ray through a pixel meets the plane; null where it runs along it or away from it. */
export function meetPlane(view: View, pixel: Pixel, point: Vector, normal: Vector): Vector | null {
  const ray = rayThrough(view, pixel);
  const eye = eyeOf(view);
  const slope = dot(ray, normal);
  if (Math.abs(slope) < 1e-9) return null;
  const t = dot(subtract(point, eye), normal) / slope;
  return t > 0 ? [eye[0] + ray[0] * t, eye[1] + ray[1] * t, eye[2] + ray[2] * t] : null;
}

/** OpenGL projection of a pinhole camera in column order, for a lens whose centre is moved by `shift` pixels. */
export function projectionMatrix(lens: Lens, near: number, far: number, shift: Pixel = [0, 0]): number[] {
  const { width, height, fx, fy } = lens;
  // Pixel centres are at integers, so the picture spans -0.5 to width - 0.5.
  const cx = lens.cx + shift[0] + 0.5;
  const cy = lens.cy + shift[1] + 0.5;
  return [
    (2 * fx) / width,
    0,
    0,
    0,
    0,
    (2 * fy) / height,
    0,
    0,
    1 - (2 * cx) / width,
    (2 * cy) / height - 1,
    -(far + near) / (far - near),
    -1,
    0,
    0,
    (-2 * far * near) / (far - near),
    0,
  ];
}

/** Greatest distance between what the lens and a pinhole show, at the picture's corners, as a share of its width. */
export function lensDeviation(lens: Lens): number {
  if (!isDistorted(lens)) return 0;
  const corners: Pixel[] = [
    [0, 0],
    [lens.width - 1, 0],
    [0, lens.height - 1],
    [lens.width - 1, lens.height - 1],
  ];
  const deviations = corners.map(([u, v]) => {
    const [x, y] = unproject(lens, [u, v]);
    return Math.hypot(lens.fx * x + lens.cx - u, lens.fy * y + lens.cy - v);
  });
  return Math.max(...deviations) / lens.width;
}
