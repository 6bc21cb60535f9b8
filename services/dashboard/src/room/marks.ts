// Signs for what the room in 3-D has besides surfaces: lamps, with the light that they give to objects, and the camera.
import {
  AmbientLight,
  BufferGeometry,
  Color,
  DirectionalLight,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
  PointLight,
  SphereGeometry,
  SpotLight,
  Vector3,
  type Light,
  type Object3D,
} from "three";
import type { ManualLight, Vector } from "../api/types";
import { eyeOf, rayThrough, type Pixel, type View } from "../math/camera";
import { add, cross, length, normalized, scaled, subtract } from "../math/vector";

const CAMERA_M = 0.15; // how far ahead of it its frame is drawn
const LAMP_M = 0.02; // where a lamp has no radius
const ARROW_M = 0.15;
const SUN_M = 1; // how far from the origin a distant light's arrow begins
const CAMERA_COLOR = "#ffb347";

type Line = readonly [Vector, Vector];

/** A light of the document as three has them; units are the same: 1 is what the camera shows white. */
export function lightOf(light: ManualLight): Light[] {
  const color = new Color().fromArray([...light.color_linear]);
  switch (light.type) {
    case "ambient":
      return [new AmbientLight(color, Math.PI * light.radiance)];
    case "directional":
      return [placed(new DirectionalLight(color, light.irradiance), scaled(light.direction, -1))];
    case "sphere":
      return [placed(new PointLight(color, light.intensity), light.position_m)];
    case "spot": {
      const half = (light.angle_deg * Math.PI) / 360;
      return [aimed(new SpotLight(color, light.intensity, 0, half, light.blend), light.position_m, light.direction)];
    }
    case "rectangle": {
      const axis = cross(light.axis_u_m, light.axis_v_m);
      const shining = new SpotLight(color, light.radiance * length(axis), 0, Math.PI / 2, 1);
      return [aimed(shining, light.position_m, axis)];
    }
  }
}

/** What stands for a lamp, in its colour. */
export function lampMark(light: ManualLight): Object3D[] {
  const color = new Color().fromArray(light.color_linear.map((value) => Math.min(1, value)));
  if (light.type === "ambient") return [];
  if (light.type === "directional") {
    const from = scaled(normalized(light.direction), -SUN_M);
    return [lines([...arrow(from, light.direction)], color)];
  }
  const radius = light.type === "sphere" ? Math.max(LAMP_M, light.radius_m) : LAMP_M;
  const ball = new Mesh(new SphereGeometry(radius, 24, 16), new MeshBasicMaterial({ color }));
  ball.position.set(...light.position_m);
  const [x, y] = light.position_m;
  const plumb: Line = [light.position_m, [x, y, 0]];
  return [ball, lines([plumb, ...shapeOf(light)], color)];
}

function shapeOf(light: ManualLight): Line[] {
  if (light.type === "spot") return arrow(light.position_m, light.direction);
  if (light.type !== "rectangle") return [];
  const { position_m: middle, axis_u_m: u, axis_v_m: v } = light;
  const corner = (s: number, t: number): Vector => add(middle, add(scaled(u, s / 2), scaled(v, t / 2)));
  const rim = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
  return rim.map((from, index): Line => [from, rim[(index + 1) % rim.length]!]);
}

function arrow(from: Vector, direction: Vector): Line[] {
  const ahead = normalized(direction);
  const tip = add(from, scaled(ahead, ARROW_M));
  const side = normalized(cross(ahead, Math.abs(ahead[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
  const back = add(from, scaled(ahead, 0.8 * ARROW_M));
  const barbs = [0.03, -0.03].map((reach): Line => [tip, add(back, scaled(side, reach))]);
  return [[from, tip], ...barbs];
}

/** A camera as the pyramid that it sees. */
export function cameraMark(view: View): Object3D {
  const { width, height } = view.lens;
  const eye = eyeOf(view);
  const corners: readonly Pixel[] = [
    [0, 0],
    [width - 1, 0],
    [width - 1, height - 1],
    [0, height - 1],
  ];
  const frame = corners.map((pixel) => add(eye, scaled(rayThrough(view, pixel), CAMERA_M)));
  const top = scaled(add(frame[0]!, frame[1]!), 0.5);
  const up = scaled(subtract(frame[0]!, frame[3]!), 0.2);
  const edges = frame.flatMap((from, index): Line[] => [
    [from, frame[(index + 1) % frame.length]!],
    [eye, from],
  ]);
  return lines([...edges, [top, add(top, up)]], new Color(CAMERA_COLOR));
}

function lines(pairs: readonly Line[], color: Color): LineSegments {
  const points = pairs.flat().map((point) => new Vector3(...point));
  return new LineSegments(new BufferGeometry().setFromPoints(points), new LineBasicMaterial({ color }));
}

function placed<T extends Light>(light: T, position: Vector): T {
  light.position.set(...position);
  return light;
}

function aimed(light: SpotLight, position: Vector, direction: Vector): SpotLight {
  light.target.position.set(...add(position, direction));
  light.target.updateMatrixWorld();
  return placed(light, position);
}
