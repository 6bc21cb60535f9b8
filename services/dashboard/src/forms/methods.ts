// What each method is good and bad at (docs/methods.md), in a sentence.
import type { MethodName } from "../api/types";

interface MethodText {
  readonly name: MethodName;
  readonly title: string;
  readonly help: string;
  readonly schema: string;
  /** The settings that people turn; the others wait behind a line. */
  readonly main: readonly string[];
}

export const METHODS: readonly MethodText[] = [
  {
    name: "dvct",
    title: "Voxel cone tracing",
    help: "The best picture: contact shadows, bounced light with sharp borders, and reflections in shiny surfaces. The cost grows with the picture.",
    schema: "DvctMethod",
    main: ["operator", "volume_size", "bounces", "caustics"],
  },
  {
    name: "dlpv",
    title: "Light propagation volumes",
    help: "Soft, steady light whose cost hardly depends on the size of the picture. Contact shadows are blurred, and there are no reflections.",
    schema: "DlpvMethod",
    main: ["operator", "volume_size", "bounces", "damping"],
  },
  {
    name: "aroof",
    title: "Occlusion fields",
    help: "For rigid objects in natural light from an environment map or fish-eye camera. The fields are computed once for each object.",
    schema: "AroofMethod",
    main: ["indirect", "composition"],
  },
  {
    name: "differential",
    title: "Differential rendering",
    help: "Two full solutions subtracted: the yardstick for the others, and the slowest.",
    schema: "DifferentialMethod",
    main: ["volume_size", "bounces"],
  },
  {
    name: "none",
    title: "No relighting",
    help: "Objects are drawn and the real scene is left as the camera saw it. Shows what relighting is worth.",
    schema: "NoneMethod",
    main: [],
  },
];

export function methodText(name: MethodName): MethodText {
  return METHODS.find((each) => each.name === name) ?? METHODS[0]!;
}
