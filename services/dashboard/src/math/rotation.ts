// Unit quaternions w x y z, and the angles that people turn.
import type { Quaternion, Vector } from "../api/types";
import { cross, dot, normalized } from "./vector";

const DEGREE = Math.PI / 180;
// Below it the axis between two opposite directions is not told by their cross product.
const OPPOSITE = -0.999999;

/** Roll about x, then pitch about y, then yaw about z (all axes fixed), degrees. */
export function quaternionFromAngles([roll, pitch, yaw]: Vector): Quaternion {
  const [cr, sr] = half(roll);
  const [cp, sp] = half(pitch);
  const [cy, sy] = half(yaw);
  return [
    cr * cp * cy + sr * sp * sy,
    sr * cp * cy - cr * sp * sy,
    cr * sp * cy + sr * cp * sy,
    cr * cp * sy - sr * sp * cy,
  ];
}

function half(degrees: number): [number, number] {
  return [Math.cos((degrees * DEGREE) / 2), Math.sin((degrees * DEGREE) / 2)];
}

/** The inverse; at a pitch of 90 degrees roll and yaw are one turn, and the roll is 0. */
export function anglesFromQuaternion([w, x, y, z]: Quaternion): Vector {
  const sine = Math.max(-1, Math.min(1, 2 * (w * y - z * x)));
  if (Math.abs(sine) > 0.9999995) return [0, Math.sign(sine) * 90, (-2 * Math.sign(sine) * Math.atan2(x, w)) / DEGREE];
  return [
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) / DEGREE,
    Math.asin(sine) / DEGREE,
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) / DEGREE,
  ];
}

export function multiply(a: Quaternion, b: Quaternion): Quaternion {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

/** The turn back. */
export function conjugate([w, x, y, z]: Quaternion): Quaternion {
  return [w, -x, -y, -z];
}

export function rotate(q: Quaternion, v: Vector): Vector {
  const axis: Vector = [q[1], q[2], q[3]];
  const first = cross(axis, v);
  const second = cross(axis, first);
  return [
    v[0] + 2 * (q[0] * first[0] + second[0]),
    v[1] + 2 * (q[0] * first[1] + second[1]),
    v[2] + 2 * (q[0] * first[2] + second[2]),
  ];
}

/** The smallest turn that takes direction `from` to direction `to` (unit vectors). */
export function turnBetween(from: Vector, to: Vector): Quaternion {
  const cosine = dot(from, to);
  if (cosine < OPPOSITE) {
    const side: Vector = Math.abs(from[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    const axis = normalized(cross(from, side));
    return [0, ...axis];
  }
  const axis = cross(from, to);
  const size = Math.sqrt(2 * (1 + cosine));
  return [size / 2, axis[0] / size, axis[1] / size, axis[2] / size];
}
