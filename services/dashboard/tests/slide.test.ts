import { beforeEach, describe, expect, it, vi } from "vitest";
import type { PickAnswer, Pose, Vector } from "../src/api/types";
import { NewestPick } from "../src/live/pick";
import { corners, footOf, restOn, standOn, type Bounds } from "../src/math/bounds";
import type { Pixel, View } from "../src/math/camera";
import { quaternionFromAngles, rotate } from "../src/math/rotation";
import { dot, subtract, UP } from "../src/math/vector";
import { stepped } from "../src/math/snap";
import { levelWay } from "../src/state/slide";
import { ABOVE } from "./views";

// A box of 10 x 20 x 30 cm whose origin is at one of its corners.
const BOX: Bounds = { minimum: [0, 0, 0], maximum: [0.1, 0.2, 0.3] };
const WALL: Vector = [-1, 0, 0];

function pose(angles: Vector, scale = 1): Pose {
  return { translation_m: [1, 2, 3], rotation_wxyz: quaternionFromAngles(angles), scale };
}

function heights(of: Pose, point: Vector, normal: Vector): number[] {
  return corners(of, BOX).map((corner) => dot(subtract(corner, point), normal));
}

describe("what rests on a surface", () => {
  it.each([
    [[0, 0, 0] as const, UP],
    [[90, 0, 30] as const, UP],
    [[10, 20, 30] as const, UP],
    [[0, 0, 0] as const, WALL],
  ])("turned by %j touches it with its lowest corner, its middle above the point", (angles, normal) => {
    const point: Vector = [0.3, -0.2, 0.5];
    const put = restOn(pose(angles, 2), BOX, point, normal);
    expect(Math.min(...heights(put, point, normal))).toBeCloseTo(0, 9);
    expect(put.rotation_wxyz).toEqual(pose(angles).rotation_wxyz);
    footOf(put, BOX, normal).forEach((value, axis) => expect(value).toBeCloseTo(point[axis]!, 9));
  });

  it("leans where it is to stand on a slope, and not where the slope is only noise", () => {
    const slope: Vector = [0, Math.sin(0.5), Math.cos(0.5)];
    const up = rotate(standOn(pose([0, 0, 40]), BOX, [0, 0, 0], slope).rotation_wxyz, UP);
    expect(dot(up, slope)).toBeCloseTo(1, 9);
    const noise: Vector = [0, Math.sin(0.05), Math.cos(0.05)];
    expect(rotate(standOn(pose([0, 0, 40]), BOX, [0, 0, 0], noise).rotation_wxyz, UP)).toEqual(UP);
  });

  it("goes by steps along its surface", () => {
    const slope: Vector = [0, Math.SQRT1_2, Math.SQRT1_2 + 1e-9];
    const [x, y, z] = stepped({ ...pose([0, 0, 0]), translation_m: [0.123, 0.456, 0.7] }, slope).translation_m;
    expect([x, y]).toEqual([0.12, 0.46]);
    expect(z).toBeCloseTo(0.696, 9);
    expect(stepped(pose([0, 0, 0]), WALL)).toEqual(pose([0, 0, 0]));
  });
});

describe("asking what is under the pointer", () => {
  beforeEach(() => void vi.useFakeTimers());

  it("asks once at a time, and only for the newest place", async () => {
    const asked: Pixel[] = [];
    const answers: ((found: PickAnswer) => void)[] = [];
    const found: PickAnswer[] = [];
    const look = (pixel: Pixel): Promise<PickAnswer> => {
      asked.push(pixel);
      return new Promise((resolve) => answers.push(resolve));
    };
    const picks = new NewestPick(look, (each) => found.push(each));
    for (const x of [1, 2, 3]) picks.ask([x, 0]);
    await vi.advanceTimersByTimeAsync(500);
    expect(asked).toEqual([[1, 0]]);
    answers[0]!({ frame_id: 1 } as PickAnswer);
    await vi.advanceTimersByTimeAsync(500);
    expect(asked).toEqual([
      [1, 0],
      [3, 0],
    ]);
    const all = picks.answered();
    answers[1]!({ frame_id: 2 } as PickAnswer);
    await all;
    expect(found.map((each) => each.frame_id)).toEqual([1, 2]);
    picks.ask([4, 0]);
    await vi.advanceTimersByTimeAsync(500);
    expect(asked.at(-1)).toEqual([4, 0]);
  });
});

describe("a lamp that is dragged at the picture's border", () => {
  it("goes as far as the pointer at its distance, and keeps its height", () => {
    const way = levelWay(ABOVE, [3, 0, 5], [60, -30]); // 5 m from the eye, behind the camera
    [0.5, 0.25, 0].forEach((value, axis) => expect(way[axis]).toBeCloseTo(value, 9));
  });

  it("goes away from a viewer who looks at the horizon", () => {
    const [right, forward, eye] = [[0, -1, 0] as const, [1, 0, 0] as const, [-2, 0, 1] as const];
    const level: View = {
      ...ABOVE,
      worldFromCamera: [
        [right[0], 0, forward[0], eye[0]],
        [right[1], 0, forward[1], eye[1]],
        [right[2], -1, forward[2], eye[2]],
        [0, 0, 0, 1],
      ],
    };
    const way = levelWay(level, [-2, 0, 3], [0, -300]);
    [1, 0, 0].forEach((value, axis) => expect(way[axis]).toBeCloseTo(value, 9));
  });
});
