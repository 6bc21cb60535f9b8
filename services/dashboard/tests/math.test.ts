import { describe, expect, it } from "vitest";
import type { AssetAnswer, Pose, Vector } from "../src/api/types";
import { boundsOf, corners, sensibleScale, standOn } from "../src/math/bounds";
import { hexFromLinear, linearFromHex } from "../src/math/color";
import { anglesFromDirection, directionFromAngles } from "../src/math/direction";
import { convexHull, isInside } from "../src/math/hull";
import { anglesFromQuaternion, quaternionFromAngles, rotate, turnBetween } from "../src/math/rotation";
import { snap } from "../src/math/snap";
import { bytes, clock, counted, labelOf, milliseconds, size, sizesText, trimmed, unitOf } from "../src/math/units";

const UPRIGHT: Pose = { translation_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], scale: 1 };

function mesh(format: string, minimum: Vector, maximum: Vector): AssetAnswer {
  return {
    asset: "sha256:0",
    names: ["a"],
    kind: "mesh",
    format,
    size_bytes: 1,
    uploaded: "",
    facts: { minimum, maximum },
  };
}

describe("rotations", () => {
  it.each([
    [10, 20, 30],
    [-170, 45, 120],
    [0, 0, -90],
    [5, -89, 3],
  ] as Vector[])("come back from angles %#", (...angles) => {
    anglesFromQuaternion(quaternionFromAngles(angles)).forEach((each, axis) =>
      expect(each).toBeCloseTo(angles[axis]!, 6),
    );
  });

  it("turn about z by the yaw", () => {
    const turned = rotate(quaternionFromAngles([0, 0, 90]), [1, 0, 0]);
    expect(turned[1]).toBeCloseTo(1, 12);
  });

  it("keep the rotation where a pitch of 90 degrees makes two angles one", () => {
    const q = quaternionFromAngles([20, 90, 50]);
    const again = quaternionFromAngles(anglesFromQuaternion(q));
    rotate(q, [0.3, 0.5, 0.7]).forEach((each, axis) =>
      expect(rotate(again, [0.3, 0.5, 0.7])[axis]).toBeCloseTo(each, 6),
    );
  });

  it("go between any two directions, opposite ones too", () => {
    for (const to of [
      [0, 0, -1],
      [1, 0, 0],
      [0, 0, 1],
      [0.6, 0, 0.8],
    ] as Vector[]) {
      rotate(turnBetween([0, 0, 1], to), [0, 0, 1]).forEach((each, axis) => expect(each).toBeCloseTo(to[axis]!, 9));
    }
  });
});

describe("boxes", () => {
  it("turn glTF's y up to z up, and leave other formats", () => {
    expect(boundsOf(mesh("glb", [0, 0, 1], [2, 5, 3]), null)).toEqual({ minimum: [0, -3, 0], maximum: [2, -1, 5] });
    expect(boundsOf(mesh("ply", [0, 0, 1], [2, 5, 3]), null)?.maximum).toEqual([2, 5, 3]);
    expect(boundsOf(mesh("ply", [0, 0, 1], [2, 5, 3]), "y")?.maximum).toEqual([2, -1, 5]);
  });

  it("have no bounds where the facts say none", () => {
    expect(boundsOf({ ...mesh("hdr", [0, 0, 0], [1, 1, 1]), facts: { width: 64, height: 32 } }, null)).toBeNull();
  });

  it("stand with the middle of the underside on the point", () => {
    const bounds = { minimum: [-1, 0, 0.5], maximum: [1, 4, 2.5] } as const;
    const pose = standOn({ ...UPRIGHT, scale: 0.1 }, bounds, [0.3, 0.2, 0.1], [0, 0, 1]);
    const all = corners(pose, bounds);
    expect(Math.min(...all.map(([, , z]) => z))).toBeCloseTo(0.1, 9);
    expect(all.reduce((sum, [x]) => sum + x, 0) / 8).toBeCloseTo(0.3, 9);
  });

  it("lean along a wall, but stay level on a table whose measured normal is a little off", () => {
    const wall = standOn(UPRIGHT, null, [0, 0, 0], [1, 0, 0]);
    expect(rotate(wall.rotation_wxyz, [0, 0, 1])[0]).toBeCloseTo(1, 9);
    expect(standOn(UPRIGHT, null, [0, 0, 0], [0.04, 0, 0.9992]).rotation_wxyz).toEqual([1, 0, 0, 0]);
  });

  it("suggest a power of ten for what is in millimetres or in kilometres", () => {
    const box = (edge: number) => ({ minimum: [0, 0, 0] as Vector, maximum: [edge, 0, 0] as Vector });
    expect(sensibleScale(box(0.3))).toBe(1);
    expect(sensibleScale(box(150))).toBeCloseTo(0.001, 9);
    expect(sensibleScale(box(0.002))).toBeCloseTo(100, 9);
  });
});

describe("small things", () => {
  it("snaps without stray digits", () => {
    expect(snap(0.123, 0.01)).toBe(0.12);
    expect(snap(-0.126, 0.01)).toBe(-0.13);
    expect(snap(37, 15)).toBe(30);
  });

  it("counts one thing and several", () => {
    expect([0, 1, 1200].map((count) => counted(count, "relit picture"))).toEqual([
      "0 relit pictures",
      "1 relit picture",
      "1,200 relit pictures",
    ]);
  });

  it("reads units and words off keys", () => {
    expect([unitOf("distance_m"), unitOf("memory_budget_mb"), unitOf("count")]).toEqual(["m", "MB", ""]);
    expect([labelOf("volume_edge_m"), labelOf("cone_count")]).toEqual(["Volume edge", "Cone count"]);
  });

  it("writes numbers as people read them", () => {
    expect([trimmed(0.3000001), trimmed(-0.00001), trimmed(120)]).toEqual(["0.3", "0", "120"]);
    expect([bytes(999), bytes(1_234_000)]).toEqual(["999 B", "1.2 MB"]);
    expect([clock(75.4), milliseconds(1234), milliseconds(4.25), size(0.0042), size(0.145)]).toEqual([
      "1:15",
      "1.23 s",
      "4.3 ms",
      "4.2 mm",
      "14.5 cm",
    ]);
  });

  it("gives the sizes of a thing in one unit", () => {
    expect(sizesText([0.145, 0.076])).toBe("14.5 × 7.6 cm");
    expect(sizesText([1.2, 0.5, 0.25])).toBe("1.2 × 0.5 × 0.25 m");
    expect(sizesText([0.0042, 0.001])).toBe("4.2 × 1 mm");
  });

  it("keeps colours through the picker, brighter ones in their own strength", () => {
    expect(hexFromLinear([1, 1, 1])).toBe("#ffffff");
    expect(linearFromHex("#808080", [1, 1, 1])[0]).toBeCloseTo(0.2159, 4);
    expect(linearFromHex(hexFromLinear([4, 2, 1]), [4, 2, 1])[0]).toBeCloseTo(4, 6);
  });

  it("turns directions of light into bearing and height", () => {
    expect(anglesFromDirection([0, 0, -1])[1]).toBe(90);
    expect(anglesFromDirection(directionFromAngles(35, 50))).toEqual([35, 50]);
  });

  it("tells inside from outside of an outline", () => {
    const hull = convexHull([
      [0, 0],
      [4, 0],
      [4, 4],
      [0, 4],
      [2, 2],
      [1, 3],
    ]);
    expect(hull).toHaveLength(4);
    expect(isInside(hull, [1, 1])).toBe(true);
    expect(isInside(hull, [5, 1])).toBe(false);
  });
});
