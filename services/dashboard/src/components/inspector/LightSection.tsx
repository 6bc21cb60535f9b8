import type { Lights, LightType, ManualLight } from "../../api/types";
import { LIGHT_TYPES } from "../../forms/lights";
import { removeLight, replaceLight } from "../../state/actions";
import { selectedLight } from "../../state/selection";
import { lightTarget } from "../../state/targets";
import { view } from "../../live/picture";
import { project } from "../../math/camera";
import { ColorField } from "../ui/ColorField";
import { Field } from "../ui/Field";
import { IconButton } from "../ui/IconButton";
import { Select } from "../ui/Select";
import { useGesture } from "../ui/useGesture";
import { LightFields } from "./LightFields";
import { Section } from "./Section";

interface LightSectionProps {
  readonly lights: Lights;
  readonly disabled: boolean;
}

const TYPES = (Object.keys(LIGHT_TYPES) as LightType[]).map((type) => ({
  value: type,
  label: LIGHT_TYPES[type].label,
}));

/** The selected lamp. */
export function LightSection({ lights, disabled }: LightSectionProps) {
  const index = selectedLight.value;
  const light = index === null ? undefined : lights.manual[index];
  if (index === null || !light) return null;
  return <LightEditor key={index} index={index} light={light} disabled={disabled} />;
}

interface LightEditorProps {
  readonly index: number;
  readonly light: ManualLight;
  readonly disabled: boolean;
}

function LightEditor({ index, light, disabled }: LightEditorProps) {
  const gesture = useGesture(lightTarget(index));
  const { label, help } = LIGHT_TYPES[light.type];
  return (
    <Section
      title={`${label} ${index + 1}`}
      action={
        <IconButton
          icon="trash"
          label="Remove light"
          hint="Del"
          disabled={disabled}
          onClick={() => removeLight(index)}
        />
      }
    >
      <Field label="Kind" help={help} inline>
        <Select
          label="Kind"
          value={light.type}
          choices={TYPES}
          onChange={(type) => changeType(index, light, type)}
          disabled={disabled}
        />
      </Field>
      {isOutOfSight(light) && (
        <p class="quiet small">
          This light is outside the picture. Move it with its fields, or drag a shadow that it casts.
        </p>
      )}
      <LightFields light={light} onChange={gesture.push} onEnd={gesture.end} disabled={disabled} />
      <ColorField
        label="Colour"
        value={light.color_linear}
        onChange={(color_linear) => gesture.push({ color_linear })}
        onEnd={gesture.end}
        max={1000}
        help="Multiplies the strength."
        disabled={disabled}
      />
    </Section>
  );
}

function isOutOfSight(light: ManualLight): boolean {
  if (!view.value || !("position_m" in light)) return false;
  const { width, height } = view.value.lens;
  const pixel = project(view.value, light.position_m);
  return !pixel || pixel[0] < 0 || pixel[1] < 0 || pixel[0] > width || pixel[1] > height;
}

/** Another kind of light with what both kinds have. */
async function changeType(index: number, light: ManualLight, type: LightType): Promise<void> {
  const hasPlace = type === "sphere" || type === "spot" || type === "rectangle";
  const place = hasPlace && "position_m" in light ? { position_m: light.position_m } : {};
  await replaceLight(index, { type, color_linear: light.color_linear, ...place });
}
