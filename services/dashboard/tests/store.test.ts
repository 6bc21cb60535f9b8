import { beforeEach, describe, expect, it, vi } from "vitest";
import type { RevisionEntry, SceneAnswer, SceneDocument } from "../src/api/types";
import { fieldOf, fieldsOf } from "../src/forms/fields";
import { methods, methodText } from "../src/forms/methods";
import { schemas } from "../src/forms/schemas";
import { Gesture } from "../src/state/gesture";
import { stepsOf } from "../src/state/history";
import { scene, sceneDocument, takeScene } from "../src/state/scene";
import { lightTarget, merged, objectTarget } from "../src/state/targets";

const POSE = { translation_m: [0, 0, 0], rotation_wxyz: [1, 0, 0, 0], scale: 1 };

function answer(id: string, revision: number): SceneAnswer {
  const document = {
    name: id,
    objects: [{ id: "knot", asset: "sha256:0", pose: POSE, visible: true }],
    lights: {
      mode: "manual",
      manual: [
        { type: "sphere", intensity: 1 },
        { type: "ambient", radiance: 0.1 },
      ],
    },
  } as unknown as SceneDocument;
  return {
    id,
    revision,
    document,
    active: true,
    what: "",
    can_undo: true,
    can_redo: false,
    picture: null,
    created: "",
    changed: "",
  };
}

describe("the scene", () => {
  it("is not replaced by an older answer that comes late", () => {
    takeScene(answer("a", 5));
    takeScene(answer("a", 4));
    expect(scene.value?.revision).toBe(5);
    takeScene(answer("b", 1));
    expect(scene.value?.id).toBe("b");
  });
});

describe("changes", () => {
  it("merge as RFC 7396 has it, lists whole", () => {
    const target = { pose: { scale: 1, at: [1, 2] }, name: "a" };
    expect(merged(target, { pose: { at: [3] } })).toEqual({ pose: { scale: 1, at: [3] }, name: "a" });
    expect(merged(target, { pose: null })).toEqual({ pose: null, name: "a" });
  });

  it("to another kind of material replace it, as in the service", () => {
    const { document } = answer("a", 1);
    const target = objectTarget("knot");
    const rough = { roughness: 0.5 };
    const painted = target.apply(target.apply(document, { material: rough }), {
      material: { precomputed: "sha256:1" },
    });
    expect(painted.objects[0]?.material).toEqual({ precomputed: "sha256:1" });
    expect(target.apply(painted, { material: rough }).objects[0]?.material).toEqual(rough);
  });

  it("reach only what they name", () => {
    const { document } = answer("a", 1);
    const moved = objectTarget("knot").apply(document, { pose: { scale: 2 } });
    expect(moved.objects[0]?.pose).toEqual({ ...POSE, scale: 2 });
    const lit = lightTarget(1).apply(document, { radiance: 0.5 });
    expect(lit.lights.manual).toEqual([
      { type: "sphere", intensity: 1 },
      { type: "ambient", radiance: 0.5 },
    ]);
  });

  it("address ids with slashes and blanks", () => {
    expect(objectTarget("a/b c").path).toBe("/objects/a%2Fb%20c");
  });
});

describe("a gesture", () => {
  beforeEach(() => {
    vi.useFakeTimers({ toFake: ["setTimeout", "performance"] });
    takeScene(answer(`scene ${Math.random()}`, 1));
  });

  it("shows at once, sends at a steady rate, the newest values only, and under one name", async () => {
    const sent: [unknown, string][] = [];
    const gesture = new Gesture(objectTarget("knot"), (_target, patch, id) => {
      sent.push([patch, id]);
      return Promise.resolve(sent.length);
    });
    gesture.push({ pose: { scale: 2 } });
    for (let scale = 3; scale < 20; scale++) gesture.push({ pose: { scale } });
    gesture.push({ visible: false });
    expect(sceneDocument.value?.objects[0]?.pose.scale).toBe(19);
    const ended = gesture.end();
    await vi.advanceTimersByTimeAsync(1000);
    expect(await ended).toBe(2);
    expect(sent.map(([patch]) => patch)).toEqual([{ pose: { scale: 2 } }, { pose: { scale: 19 }, visible: false }]);
    expect(new Set(sent.map(([, id]) => id)).size).toBe(1);
    expect(sceneDocument.value?.objects[0]?.pose.scale).toBe(1); // the service's answer counts now
  });

  it("has no revision where nothing was accepted", async () => {
    const gesture = new Gesture(objectTarget("knot"), () => Promise.resolve(null));
    gesture.push({ visible: false });
    expect(await gesture.end()).toBeNull();
  });
});

describe("the history", () => {
  const entry = (revision: number, gesture: string | null): RevisionEntry => ({
    revision,
    gesture,
    at: "",
    what: "",
    name: "",
  });

  it("shows each gesture as one step", () => {
    const steps = stepsOf([entry(5, "b"), entry(4, "a"), entry(3, "a"), entry(2, null), entry(1, null)]);
    expect(steps.map((step) => [step.entry.revision, step.count])).toEqual([
      [5, 1],
      [4, 2],
      [2, 1],
      [1, 1],
    ]);
  });
});

describe("methods", () => {
  it("of plugins are read from the service's own schema", () => {
    const ref = (name: string) => ({ $ref: `#/components/schemas/${name}` });
    schemas.value = {
      SceneDocument: { properties: { method: { oneOf: [ref("DvctMethod"), ref("DirectMethod")] } } },
      DvctMethod: { properties: { name: { const: "dvct" } } },
      DirectMethod: {
        description: "Lamps and their shadows.",
        properties: { name: { const: "direct_light" }, ambient: { type: "number" }, names: { type: "array" } },
      },
    };
    expect(methods.value.map(({ name }) => name as string)).toEqual([
      "dvct",
      "dlpv",
      "aroof",
      "differential",
      "none",
      "direct_light",
    ]);
    expect(methodText("direct_light" as "dvct")).toEqual({
      name: "direct_light",
      title: "Direct light",
      help: "Lamps and their shadows.",
      schema: "DirectMethod",
      main: ["ambient"],
    });
    schemas.value = {};
    expect(methods.value).toHaveLength(5);
  });
});

describe("forms", () => {
  it("read numbers with their ranges, and null as a value of its own", () => {
    const field = fieldOf("volume_edge_m", {
      anyOf: [{ type: "number", minimum: 0.01, maximum: 20 }, { type: "null" }],
      description: "Edge.",
    });
    expect(field).toMatchObject({
      kind: "number",
      label: "Volume edge",
      unit: "m",
      min: 0.01,
      max: 20,
      isNullable: true,
      help: "Edge.",
    });
  });

  it("leave out what has a form of its own", () => {
    const fields = fieldsOf({
      properties: {
        name: { const: "dvct", type: "string" },
        operator: { enum: ["exact", "paper"], type: "string" },
        point: { type: "array" },
        far: { type: "boolean" },
        steps: { type: "integer", multipleOf: 8 },
      },
    });
    expect(fields.map(({ key, kind }) => [key, kind])).toEqual([
      ["operator", "choice"],
      ["far", "switch"],
      ["steps", "number"],
    ]);
    expect(fields[2]).toMatchObject({ step: 8, isInteger: true });
  });
});
