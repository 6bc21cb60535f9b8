import { describe, expect, it, vi } from "vitest";
import { ProblemError } from "../src/api/http";
import type { PickAnswer, Pose, Vector } from "../src/api/types";
import type { Bounds } from "../src/math/bounds";
import { isInPicture, meetPlane, type Pixel, type View } from "../src/math/camera";
import { UP } from "../src/math/vector";
import { beforeWall, footprintOf, freePlace, isFree, standable, startAt, type Wanted } from "../src/state/freeSpace";

const BOX: Bounds = { minimum: [-0.1, -0.1, 0], maximum: [0.1, 0.1, 0.2] };
const UPRIGHT: Pose = { translation_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], scale: 1 };
// 2 m above the table, looking straight down: x to the right, y up the picture.
const VIEW: View = {
  lens: { width: 640, height: 480, fx: 500, fy: 500, cx: 319.5, cy: 239.5, model: "plumb_bob", coefficients: [] },
  worldFromCamera: [
    [1, 0, 0, 0],
    [0, -1, 0, 0],
    [0, 0, -1, 2],
    [0, 0, 0, 1],
  ],
};
const MIDDLE: Pixel = [319.5, 239.5];

function wanted(...taken: Vector[]): Wanted {
  const footprints = taken.map((translation_m) => footprintOf({ ...UPRIGHT, translation_m }, BOX));
  return { view: VIEW, start: [0, 0, 0], pose: UPRIGHT, bounds: BOX, taken: footprints };
}

/** A table at height 0, with objects of a scene and of the room on it. */
function look(seenAt: (point: Vector) => Partial<PickAnswer> = () => ({})): (pixel: Pixel) => Promise<PickAnswer> {
  return (pixel) => {
    const point_m = meetPlane(VIEW, pixel, [0, 0, 0], UP)!;
    const table: PickAnswer = { frame_id: 1, kind: "real", object: null, point_m, normal: UP, distance_m: 2 };
    return Promise.resolve({ ...table, ...seenAt(point_m) });
  };
}

const radius = footprintOf(UPRIGHT, BOX).radius;

describe("room for a new object", () => {
  it("begins at the surface in the picture's middle, or where the board's plane is behind what stands there", async () => {
    const shelf = look(([x, y]) => ({ point_m: [x, y, 0.4] }));
    expect((await startAt(VIEW, MIDDLE, shelf))![2]).toBe(0.4);
    const virtual = look(() => ({ kind: "object", object: "first", normal: [1, 0, 0] }));
    expect((await startAt(VIEW, MIDDLE, virtual))![2]).toBeCloseTo(0, 9);
  });

  it("is where it is wanted where nothing stands there", async () => {
    const place = await freePlace(wanted(), look());
    place!.forEach((value) => expect(value).toBeCloseTo(0, 9));
  });

  it("is beside an object that stands there, and not on it", async () => {
    const virtual = look(([x, y]) =>
      Math.hypot(x, y) < 0.1 ? { kind: "object", object: "first", normal: [1, 0, 0] } : {},
    );
    const place = await freePlace(wanted([0, 0, 0]), virtual);
    expect(place![2]).toBeCloseTo(0, 9);
    expect(isFree(place!, radius, wanted([0, 0, 0]).taken)).toBe(true);
    expect(Math.hypot(place![0], place![1])).toBeLessThan(0.6);
  });

  it("is not where a real thing stands in the way, or where the surface is a wall", async () => {
    const room = look(([x, y]) => (x > 0.2 ? { normal: [-1, 0, 0] } : y > 0.2 ? { point_m: [x, y, 0.3] } : {}));
    const place = await freePlace(wanted([0, 0, 0]), room);
    expect(place![0] + radius).toBeLessThan(0.2);
    expect(place![1] + radius).toBeLessThan(0.2);
    expect(place![2]).toBeCloseTo(0, 9);
  });

  it("is looked for in the picture alone", async () => {
    const asked: Pixel[] = [];
    const near = { ...wanted(), start: [1.1, 0, 0] as const }; // 45 px from the right edge; the object spans 70 px
    const place = await freePlace(near, (pixel) => {
      asked.push(pixel);
      return look()(pixel);
    });
    expect(place).not.toBeNull();
    expect(asked.length).toBeGreaterThan(0);
    expect(asked.every((pixel) => isInPicture(VIEW.lens, pixel))).toBe(true);
  });

  it("is none where every place is taken or none can be stood on", async () => {
    expect(
      await freePlace(
        wanted(),
        look(() => ({ normal: [1, 0, 0] })),
      ),
    ).toBeNull();
  });

  it("is not looked for any longer when the service refuses to look", async () => {
    const busy = new ProblemError(503, "render-server", "The render server does not answer.");
    const refuse = vi.fn(() => Promise.reject(busy));
    await expect(freePlace(wanted(), refuse)).rejects.toBe(busy);
    expect(refuse.mock.calls.length).toBeLessThanOrEqual(5); // of one place, at the same time
  });
});

describe("what is dropped on a wall", () => {
  it("stands on the board's plane, before the wall", () => {
    expect(beforeWall([1, 2, 0.5], [-1, 0, 0], 0.25)).toEqual([0.75, 2, 0]);
    expect(beforeWall([1, 2, 0.5], [0, 0.6, 0.8], 0.25)).toEqual([1, 2.25, 0]);
    expect(beforeWall([1, 2, 0.5], null, 0.25)).toEqual([1, 2, 0]);
  });
});

describe("what can be stood on", () => {
  const table: PickAnswer = {
    frame_id: 1,
    kind: "real",
    object: null,
    point_m: [1, 2, 0],
    normal: UP,
    distance_m: 1,
  };

  it("is a real surface that is not too steep", () => {
    expect(standable(table)).toEqual([1, 2, 0]);
    expect(standable({ ...table, normal: null })).toEqual([1, 2, 0]);
    expect(standable({ ...table, normal: [1, 0, 0] })).toBeNull();
    expect(standable({ ...table, kind: "object", object: "first" })).toBeNull();
    expect(standable({ ...table, kind: "nothing", point_m: null })).toBeNull();
  });
});
