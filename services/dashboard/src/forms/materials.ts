// Materials to begin with. Colours of metals as tabulated for physically based materials (documentation of Unreal Engine).
import type { Material } from "../api/types";

interface Preset {
  readonly label: string;
  readonly material: Partial<Material>;
}

const METAL = { metallic: 1, specular: 0.5, transmission: 0 };
const PLAIN = { metallic: 0, specular: 0.5, transmission: 0 };

export const MATERIALS: readonly Preset[] = [
  { label: "Matte", material: { ...PLAIN, roughness: 1 } },
  { label: "Plastic", material: { ...PLAIN, roughness: 0.35 } },
  { label: "Glaze", material: { ...PLAIN, roughness: 0.12 } },
  { label: "Glass", material: { ...PLAIN, roughness: 0, transmission: 1, base_color: [1, 1, 1] } },
  { label: "Brushed metal", material: { ...METAL, roughness: 0.45 } },
  { label: "Chrome", material: { ...METAL, roughness: 0.05, base_color: [0.55, 0.556, 0.554] } },
  { label: "Gold", material: { ...METAL, roughness: 0.2, base_color: [1, 0.766, 0.336] } },
  { label: "Copper", material: { ...METAL, roughness: 0.2, base_color: [0.955, 0.638, 0.538] } },
];
