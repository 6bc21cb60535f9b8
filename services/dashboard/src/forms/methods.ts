// What each method is good and bad at (docs/methods.md), in a sentence; methods of plugins speak for themselves.
import { computed } from "@preact/signals";
import type { MethodName } from "../api/types";
import { labelOf } from "../math/units";
import { fieldsOf } from "./fields";
import { schemas, type JsonSchema } from "./schemas";

interface MethodText {
  readonly name: MethodName;
  readonly title: string;
  readonly help: string;
  readonly schema: string;
  /** The settings that people turn; the others wait behind a line. */
  readonly main: readonly string[];
}

const OWN: readonly MethodText[] = [
  {
    name: "dvct",
    title: "Voxel cone tracing",
    help: "The best picture: contact shadows, sharp bounced light, and reflections in shiny surfaces. The cost grows with the size of the picture.",
    schema: "DvctMethod",
    main: ["quality", "operator", "volume_size", "bounces", "caustics"],
  },
  {
    name: "dlpv",
    title: "Light propagation volumes",
    help: "Soft, steady light whose cost hardly depends on the size of the picture. Contact shadows are blurred, and there are no reflections.",
    schema: "DlpvMethod",
    main: ["quality", "operator", "volume_size", "bounces", "damping"],
  },
  {
    name: "aroof",
    title: "Occlusion fields",
    help: "For rigid objects in natural light from an environment map or fish-eye camera. The fields are computed once for each object.",
    schema: "AroofMethod",
    main: ["quality", "indirect", "composition"],
  },
  {
    name: "differential",
    title: "Differential rendering",
    help: "The difference of two full solutions. The reference for the other methods, and the slowest.",
    schema: "DifferentialMethod",
    main: ["quality", "volume_size", "bounces"],
  },
  {
    name: "none",
    title: "No relighting",
    help: "Objects are drawn, and the real scene stays as the camera saw it. Shows what relighting adds.",
    schema: "NoneMethod",
    main: ["quality"],
  },
];

/** Every method that the service knows: the project's own, then those of plugins. */
export const methods = computed<readonly MethodText[]>(() => [...OWN, ...installed(schemas.value)]);

function installed(known: Readonly<Record<string, JsonSchema>>): MethodText[] {
  const models = known.SceneDocument?.properties?.method?.oneOf ?? [];
  return models.flatMap(({ $ref }) => {
    const schema = $ref?.split("/").at(-1) ?? "";
    const name = known[schema]?.properties?.name?.const as MethodName | undefined;
    if (name === undefined || OWN.some((each) => each.name === name)) return [];
    const main = fieldsOf(known[schema]).map(({ key }) => key);
    return [{ name, title: labelOf(name), help: known[schema]?.description ?? "", schema, main }];
  });
}

export function methodText(name: MethodName): MethodText {
  return methods.value.find((each) => each.name === name) ?? OWN[0]!;
}
