import { describe, expect, it } from "vitest";
import type { Pose, Vector } from "../src/api/types";
import type { Bounds } from "../src/math/bounds";
import { quaternionFromAngles } from "../src/math/rotation";
import { insideBox, sourceOf, strengthAt, withShadowAt, type ShadowLight } from "../src/math/shadow";
import { cross, dot, length, normalized, subtract } from "../src/math/vector";

const BOX: Bounds = { minimum: [-0.1, -0.1, 0], maximum: [0.1, 0.1, 0.2] };
const UPRIGHT: Pose = { translation_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], scale: 1 };
const THROWER: Vector = [0, 0, 0.1];
const SHADOW: Vector = [-0.3, 0.1, 0];
const COLOR = { color_linear: [1, 1, 1] } as const;
const LAMP: ShadowLight = { type: "sphere", position_m: [0.9, 0, 1], intensity: 8, radius_m: 0.05, ...COLOR };
const SUN: ShadowLight = {
  type: "directional",
  direction: [0, 0, -1],
  irradiance: 1,
  angular_radius_deg: 0.5,
  ...COLOR,
};

function expectClose(found: Vector | null, wanted: Vector): void {
  expect(found).not.toBeNull();
  found!.forEach((value, axis) => expect(value).toBeCloseTo(wanted[axis]!, 4));
}

describe("what throws a shadow", () => {
  it("is the part of a box that lies between surface and lamp", () => {
    expectClose(insideBox(UPRIGHT, BOX, [0, 0, -1], [0, 0, 1]), [0, 0, 0.1]);
    expectClose(insideBox(UPRIGHT, BOX, [-1, 0, 0.1], [0, 0, 0.1]), [-0.05, 0, 0.1]); // which ends inside
    expect(insideBox(UPRIGHT, BOX, [0.2, 0, -1], [0.2, 0, 1])).toBeNull();
    expect(insideBox(UPRIGHT, BOX, [0, 0, -1], [0, 0, -0.5])).toBeNull(); // the lamp is before it
  });

  it("is found where the box is turned, scaled and moved", () => {
    const pose: Pose = { translation_m: [1, 2, 3], rotation_wxyz: quaternionFromAngles([0, 90, 0]), scale: 2 };
    expectClose(insideBox(pose, BOX, [0, 2, 3], [3, 2, 3]), [1.2, 2, 3]); // its up is along x
    expect(insideBox(pose, BOX, [1.2, 2, 3.21], [1.2, 3, 3.21])).toBeNull();
  });
});

describe("a lamp whose shadow is dragged", () => {
  const { position_m } = withShadowAt(LAMP, THROWER, SHADOW) as { position_m: Vector };

  it("is in line with the shadow and what throws it, as far away as before", () => {
    expect(length(subtract(position_m, THROWER))).toBeCloseTo(length(subtract(LAMP.position_m, THROWER)), 4);
    expect(length(cross(subtract(position_m, THROWER), subtract(THROWER, SHADOW)))).toBeCloseTo(0, 4);
    expect(dot(subtract(position_m, THROWER), subtract(THROWER, SHADOW))).toBeGreaterThan(0);
  });

  it("keeps on shining at it, be it a spot or an area", () => {
    const aimed = normalized(subtract(THROWER, LAMP.position_m));
    const spot: ShadowLight = { ...LAMP, type: "spot", direction: aimed, angle_deg: 30, blend: 0.2 };
    const turned = withShadowAt(spot, THROWER, SHADOW) as { direction: Vector };
    expectClose(turned.direction, normalized(subtract(THROWER, position_m)));
    const side = normalized(cross(aimed, [0, 0, 1]));
    const area = { type: "rectangle", axis_u_m: side, axis_v_m: cross(aimed, side), radiance: 1, ...COLOR } as const;
    const found = withShadowAt({ ...area, position_m: LAMP.position_m }, THROWER, SHADOW) as {
      axis_u_m: Vector;
      axis_v_m: Vector;
    };
    expectClose(normalized(cross(found.axis_u_m, found.axis_v_m)), turned.direction);
  });

  it("may be the sun, whose light then travels from what throws the shadow to it", () => {
    const { direction } = withShadowAt(SUN, THROWER, SHADOW) as { direction: Vector };
    expectClose(direction, normalized(subtract(SHADOW, THROWER)));
    expectClose(sourceOf(SUN, SHADOW), [-0.3, 0.1, 100]);
  });

  it("does not move where the shadow stays", () => {
    const along = subtract(THROWER, LAMP.position_m);
    const factor = THROWER[2] / (LAMP.position_m[2] - THROWER[2]);
    const stays: Vector = [THROWER[0] + along[0] * factor, THROWER[1] + along[1] * factor, 0];
    expectClose((withShadowAt(LAMP, THROWER, stays) as { position_m: Vector }).position_m, LAMP.position_m);
  });
});

describe("the strength of a light", () => {
  it("falls with the square of the distance, but not of the sun's", () => {
    expect(strengthAt(LAMP, [0.9, 0, -1])).toBeCloseTo(2, 9);
    expect(strengthAt(SUN, [0, 0, -100])).toBe(1);
  });
});
