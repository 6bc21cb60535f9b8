import type { View } from "../api/types";

interface ViewText {
  readonly value: View;
  readonly label: string;
  readonly help: string;
}

export const VIEWS: readonly ViewText[] = [
  { value: "composite", label: "Picture", help: "The finished picture." },
  { value: "effects", label: "Effects", help: "Objects and the change of light on a mid-grey background." },
  {
    value: "delta",
    label: "Change of light",
    help: "Added light in its own colour and lost light in red, amplified four times.",
  },
  {
    value: "error",
    label: "Error of the paper",
    help: "Error of the operator printed in the paper: red to yellow is too dark, blue to white too bright. Black with other methods.",
  },
  { value: "volume", label: "Volume", help: "The lit voxels or cells." },
  {
    value: "rsm",
    label: "Light's view",
    help: "What the first light sees: the real scene on the left, objects on the right.",
  },
  { value: "lights", label: "Lights", help: "The lights found in the fish-eye picture." },
  { value: "camera", label: "Camera", help: "The camera's own picture, without objects." },
];
