import type { Lights, TrackedLamp } from "../../api/types";
import { edit } from "../../state/gesture";
import { partTarget } from "../../state/targets";
import { Button } from "../ui/Button";
import { ColorField } from "../ui/ColorField";
import { Field } from "../ui/Field";
import { IconButton } from "../ui/IconButton";
import { NumberInput } from "../ui/NumberInput";
import { SliderField } from "../ui/SliderField";
import { useGesture } from "../ui/useGesture";
import { VectorInput } from "../ui/VectorInput";
import { Section } from "./Section";

interface TrackedSectionProps {
  readonly lights: Lights;
  readonly disabled: boolean;
}

/** Lamps with markers on them. */
export function TrackedSection({ lights, disabled }: TrackedSectionProps) {
  const gesture = useGesture(partTarget("lights"));
  const lamps = lights.tracked;
  const change = (index: number, values: Partial<TrackedLamp>): void =>
    gesture.push({ tracked: lamps.map((lamp, at) => (at === index ? { ...lamp, ...values } : lamp)) });
  const add = async (): Promise<void> => {
    const free = Math.max(-1, ...lamps.map((lamp) => lamp.marker)) + 1;
    await edit(partTarget("lights"), { tracked: [...lamps, { marker: free }] });
  };
  const remove = (index: number) => edit(partTarget("lights"), { tracked: lamps.filter((_, at) => at !== index) });
  return (
    <>
      {lamps.map((lamp, index) => (
        <Section
          key={index}
          title={`Lamp on marker ${lamp.marker}`}
          action={
            <IconButton
              icon="trash"
              label={`Remove lamp ${index + 1}`}
              disabled={disabled || lamps.length === 1}
              onClick={() => remove(index)}
            />
          }
        >
          <LampFields
            lamp={lamp}
            onChange={(values) => change(index, values)}
            onEnd={gesture.end}
            disabled={disabled}
          />
        </Section>
      ))}
      <div class="section">
        <Button icon="add" onClick={add} disabled={disabled || lamps.length >= 16}>
          Add lamp
        </Button>
      </div>
    </>
  );
}

interface LampFieldsProps {
  readonly lamp: TrackedLamp;
  readonly onChange: (values: Partial<TrackedLamp>) => void;
  readonly onEnd: () => void;
  readonly disabled: boolean;
}

function LampFields({ lamp, onChange, onEnd, disabled }: LampFieldsProps) {
  const common = { onEnd, disabled };
  return (
    <>
      <Field label="Marker" help="Id of one of the lamp markers in board.yaml." inline>
        <NumberInput
          label="Marker"
          value={lamp.marker}
          onChange={(marker) => marker !== null && onChange({ marker })}
          min={0}
          step={1}
          integer
          {...common}
        />
      </Field>
      <VectorInput
        label="Bulb"
        unit="m"
        help="Position of the bulb in the marker's frame: x right, y up the marker, z out of it."
        value={lamp.offset_m}
        onChange={(offset_m) => onChange({ offset_m })}
        {...common}
      />
      <SliderField
        label="Intensity"
        unit="m²"
        value={lamp.intensity}
        onChange={(intensity) => onChange({ intensity })}
        min={0}
        max={20}
        numberMax={1e9}
        step={0.05}
        {...common}
      />
      <Field label="Radius" inline>
        <NumberInput
          label="Radius"
          unit="m"
          value={lamp.radius_m}
          onChange={(radius_m) => radius_m !== null && onChange({ radius_m })}
          min={0}
          max={100}
          {...common}
        />
      </Field>
      <ColorField
        label="Colour"
        value={lamp.color_linear}
        onChange={(color_linear) => onChange({ color_linear })}
        max={1000}
        {...common}
      />
    </>
  );
}
