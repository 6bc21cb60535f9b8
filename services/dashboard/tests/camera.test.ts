import { describe, expect, it } from "vitest";
import {
  lensDeviation,
  lensOf,
  meetPlane,
  pixelOf,
  project,
  projectionMatrix,
  unproject,
  type View,
} from "../src/math/camera";

const BASE = {
  width: 640,
  height: 480,
  matrix: [600, 0, 320, 0, 590, 235, 0, 0, 1],
  distortion_model: "plumb_bob" as const,
};
const PINHOLE = lensOf({ ...BASE, distortion: [] });
const BENT = lensOf({ ...BASE, distortion: [-0.28, 0.09, 0.001, -0.0007, 0.01] });
const FISHEYE = lensOf({ ...BASE, distortion_model: "equidistant", distortion: [-0.02, 0.004, 0, 0] });
// 1 m above the board's origin, looking straight down: optical x = world x, optical y = world -y.
const ABOVE: View = {
  lens: PINHOLE,
  worldFromCamera: [
    [1, 0, 0, 0],
    [0, -1, 0, 0],
    [0, 0, -1, 1],
    [0, 0, 0, 1],
  ],
};

describe("projection", () => {
  it("shows the point below the camera at the principal point, and y up on the board as up in the picture", () => {
    expect(project(ABOVE, [0, 0, 0])).toEqual([320, 235]);
    expect(project(ABOVE, [0.1, 0.1, 0])).toEqual([380, 176]);
  });

  it("has no pixel for what is behind the camera", () => {
    expect(project(ABOVE, [0, 0, 2])).toBeNull();
  });

  it("agrees with OpenCV's projectPoints for a bent lens", () => {
    // cv2.projectPoints of (0.2, -0.15, 1) with these intrinsics and coefficients
    const [u, v] = pixelOf(BENT, 0.2, -0.15);
    expect(u).toBeCloseTo(437.84663, 4);
    expect(v).toBeCloseTo(148.10563, 4);
  });

  it("agrees with OpenCV's fisheye.projectPoints", () => {
    const [u, v] = pixelOf(FISHEYE, 0.6, -0.4);
    expect(u).toBeCloseTo(629.65128, 4);
    expect(v).toBeCloseTo(32.00638, 4);
  });

  it.each([PINHOLE, BENT, FISHEYE])("is undone by unproject all over the picture", (lens) => {
    for (const pixel of [
      [0, 0],
      [639, 0],
      [12, 470],
      [639, 479],
      [320, 235],
    ] as const) {
      const [x, y] = unproject(lens, pixel);
      const [u, v] = pixelOf(lens, x, y);
      expect(Math.hypot(u - pixel[0], v - pixel[1])).toBeLessThan(1e-3);
    }
  });

  it("meets the plane where the point came from", () => {
    const bent: View = { ...ABOVE, lens: BENT };
    const pixel = project(bent, [0.12, -0.07, 0.05])!;
    const met = meetPlane(bent, pixel, [0, 0, 0.05], [0, 0, 1])!;
    expect(met[0]).toBeCloseTo(0.12, 6);
    expect(met[1]).toBeCloseTo(-0.07, 6);
    expect(meetPlane(ABOVE, [320, 235], [0, 0, 2], [0, 0, 1])).toBeNull();
  });

  it("tells how far the lens bends the corners", () => {
    expect(lensDeviation(PINHOLE)).toBe(0);
    expect(lensDeviation(BENT)).toBeGreaterThan(0.02);
  });
});

describe("the OpenGL projection", () => {
  it("puts pixel centres where the picture has them", () => {
    const m = projectionMatrix(PINHOLE, 0.01, 100);
    const at = (row: number, column: number): number => m[column * 4 + row]!;
    // a point of the optical frame, in three's axes: y and z turned round
    const [x, y, z] = [0.1, -0.2, -2];
    const w = -z;
    const ndcX = (at(0, 0) * x + at(0, 2) * z) / w;
    const ndcY = (at(1, 1) * y + at(1, 2) * z) / w;
    expect(((ndcX + 1) / 2) * 640 - 0.5).toBeCloseTo(600 * 0.05 + 320, 9);
    expect(((1 - ndcY) / 2) * 480 - 0.5).toBeCloseTo(590 * 0.1 + 235, 9);
  });
});
