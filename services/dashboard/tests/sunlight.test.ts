import { describe, expect, it } from "vitest";
import type { Vector } from "../src/api/types";
import { ASSUMED_ALBEDO, besideTip, directionFrom, irradianceFrom } from "../src/math/sunlight";
import { dot, subtract, UP } from "../src/math/vector";

const TIP: Vector = [0.3, 0, 0];
const TOP: Vector = [0, 0, 0.4];

describe("a light from a shadow", () => {
  it("travels from what throws the shadow to its tip", () => {
    const found = directionFrom(TIP, TOP, UP)!;
    [0.6, 0, -0.8].forEach((value, axis) => expect(found[axis]).toBeCloseTo(value, 12));
  });

  it("cannot come from behind the surface, nor from the tip itself", () => {
    expect(directionFrom(TIP, [0, 0, -0.4], UP)).toBeNull();
    expect(directionFrom(TIP, TIP, UP)).toBeNull();
  });

  it("is compared with its shadow on the surface, beyond the tip and before it", () => {
    const [lit, dark] = besideTip(TIP, UP, directionFrom(TIP, TOP, UP)!);
    expect(lit[0]).toBeGreaterThan(TIP[0]);
    expect(dark[0]).toBeLessThan(TIP[0]);
    for (const point of [lit, dark]) expect(dot(subtract(point, TIP), UP)).toBeCloseTo(0, 12);
  });

  it("is as strong as the difference of both, for a grey diffuse surface", () => {
    const direction = directionFrom(TIP, TOP, UP)!;
    const [sun, rest] = [3, 0.8];
    const radiance = (irradiance: number): number => (ASSUMED_ALBEDO * irradiance) / Math.PI;
    expect(irradianceFrom(radiance(0.8 * sun + rest), radiance(rest), UP, direction)).toBeCloseTo(sun, 12);
    expect(irradianceFrom(0.5, 0.49, UP, direction)).toBeNull();
  });
});
