import type { LightType } from "../api/types";
import type { IconName } from "../components/ui/Icon";

interface LightText {
  readonly label: string;
  readonly icon: IconName;
  readonly help: string;
}

export const LIGHT_TYPES: Readonly<Record<LightType, LightText>> = {
  sphere: { label: "Lamp", icon: "lamp", help: "Shines equally in all directions." },
  spot: { label: "Spot", icon: "lamp", help: "Shines into a cone." },
  rectangle: { label: "Area light", icon: "frame", help: "A rectangle that shines to one side." },
  directional: { label: "Sun", icon: "sun", help: "A distant light, the same everywhere." },
  ambient: { label: "Ambient light", icon: "layers", help: "The same radiance from every direction." },
};
