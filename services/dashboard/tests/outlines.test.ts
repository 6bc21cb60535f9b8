import { describe, expect, it } from "vitest";
import type { ManualLight, Vector } from "../src/api/types";
import { lampMarks } from "../src/components/stage/outlines";
import { ABOVE } from "./views";

const SHEET = { view: ABOVE, factor: 1, width: 640, height: 480 };

function mark(position_m: Vector) {
  const lamp = { type: "sphere", position_m, intensity: 1, radius_m: 0.1, color_linear: [1, 1, 1] } as ManualLight;
  return lampMarks(SHEET, [lamp])[0]!;
}

describe("marks of lamps", () => {
  it("stand where the picture shows them", () => {
    expect(mark([0, 0, 0])).toMatchObject({ at: [320, 240], isOutside: false });
  });

  it("wait at the border, pointing at lamps beside the picture", () => {
    const right = mark([3, 0, 0]);
    expect(right).toMatchObject({ at: [622, 240], isOutside: true });
    expect(right.towards).toBeCloseTo(0);
  });

  it("wait at the side to turn to for lamps behind the camera", () => {
    const behind = mark([-1, 0, 2]);
    expect(behind).toMatchObject({ at: [18, 240], isOutside: true });
    expect(Math.abs(behind.towards)).toBeCloseTo(Math.PI);
    expect(mark([0, 1, 3]).at[1]).toBe(18);
  });
});
