import type { EnvironmentLights, Lights } from "../../api/types";
import { assetName, assets } from "../../state/assets";
import { partTarget } from "../../state/targets";
import { Field } from "../ui/Field";
import { Select } from "../ui/Select";
import { SliderField } from "../ui/SliderField";
import { useGesture } from "../ui/useGesture";
import { Section } from "./Section";

interface EnvironmentSectionProps {
  readonly lights: Lights;
  readonly disabled: boolean;
}

export function EnvironmentSection({ lights, disabled }: EnvironmentSectionProps) {
  const gesture = useGesture(partTarget("lights"));
  const push = (environment: Partial<EnvironmentLights>): void => gesture.push({ environment });
  const maps = assets.value.filter((each) => each.kind === "map");
  const { map, rotation_deg, intensity } = lights.environment;
  return (
    <Section title="Environment map">
      <Field label="Map" help="A panorama, twice as wide as it is high. Upload .hdr or .exr files under Assets." inline>
        <Select
          label="Map"
          value={map ?? ""}
          choices={maps.map((each) => ({ value: each.asset, label: assetName(each) }))}
          onChange={(chosen) => push({ map: chosen })}
          disabled={disabled}
        />
      </Field>
      <SliderField
        label="Rotation"
        unit="°"
        value={rotation_deg}
        onChange={(value) => push({ rotation_deg: value })}
        onEnd={gesture.end}
        min={-180}
        max={180}
        step={1}
        disabled={disabled}
      />
      <SliderField
        label="Intensity"
        value={intensity}
        onChange={(value) => push({ intensity: value })}
        onEnd={gesture.end}
        min={0}
        max={5}
        numberMax={1e9}
        step={0.05}
        disabled={disabled}
      />
    </Section>
  );
}
