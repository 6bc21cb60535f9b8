import type { Lights } from "../../api/types";
import { fieldsOf } from "../../forms/fields";
import { SchemaForm } from "../../forms/SchemaForm";
import { schemas } from "../../forms/schemas";
import { partTarget } from "../../state/targets";
import { Field } from "../ui/Field";
import { NumberInput } from "../ui/NumberInput";
import { Select } from "../ui/Select";
import { useGesture } from "../ui/useGesture";
import { Section } from "./Section";

interface FisheyeSectionProps {
  readonly lights: Lights;
  readonly disabled: boolean;
}

/** How lights are cut out of a picture of the surroundings. */
export function FisheyeSection({ lights, disabled }: FisheyeSectionProps) {
  const gesture = useGesture(partTarget("lights"));
  const push = (key: string, value: unknown): void => gesture.push({ fisheye: { [key]: value } });
  const distance = lights.fisheye.distance_m;
  const isMetres = typeof distance === "number";
  return (
    <Section title={lights.mode === "fisheye" ? "Lights found in the fish-eye picture" : "Lights found in the map"}>
      <SchemaForm
        fields={fieldsOf(schemas.value.FisheyeLights)}
        values={lights.fisheye}
        onChange={push}
        onEnd={gesture.end}
        disabled={disabled}
      />
      {lights.mode === "fisheye" && (
        <Field label="Distance" help={schemas.value.FisheyeLights?.properties?.distance_m?.description} inline>
          <Select
            label="Distance"
            value={isMetres ? "metres" : distance}
            choices={[
              { value: "auto", label: "Measured" },
              { value: "far", label: "Far away" },
              { value: "metres", label: "Given" },
            ]}
            onChange={(choice) => push("distance_m", choice === "metres" ? 2 : choice)}
            disabled={disabled}
          />
        </Field>
      )}
      {lights.mode === "fisheye" && isMetres && (
        <Field label="" inline>
          <NumberInput
            label="Distance in metres"
            unit="m"
            value={distance}
            onChange={(value) => push("distance_m", value)}
            min={0.01}
            max={1000}
            step={0.1}
            disabled={disabled}
          />
        </Field>
      )}
    </Section>
  );
}
