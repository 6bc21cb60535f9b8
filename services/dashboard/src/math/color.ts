// Linear R G B and the sRGB codes of screens and colour pickers.
import type { Vector } from "../api/types";

function encode(linear: number): number {
  const value = Math.max(0, Math.min(1, linear));
  return value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055;
}

function decode(code: number): number {
  return code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4;
}

/** The colour of the picker, `#rrggbb`; what is brighter than 1 is brought down in its own hue. */
export function hexFromLinear(linear: Vector): string {
  const peak = Math.max(1, ...linear);
  return `#${linear.map((value) => byte(encode(value / peak))).join("")}`;
}

function byte(value: number): string {
  return Math.round(255 * value)
    .toString(16)
    .padStart(2, "0");
}

/** Linear values of a picked colour, to four digits, as strong as `previous` where that is brighter than 1. */
export function linearFromHex(hex: string, previous: Vector): Vector {
  const peak = Math.max(1, ...previous);
  const channel = (index: number): number =>
    Number((peak * decode(parseInt(hex.slice(1 + 2 * index, 3 + 2 * index), 16) / 255)).toPrecision(4));
  return [channel(0), channel(1), channel(2)];
}
