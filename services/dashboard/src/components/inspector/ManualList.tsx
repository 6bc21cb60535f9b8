import type { Lights } from "../../api/types";
import { LIGHT_TYPES } from "../../forms/lights";
import { hexFromLinear } from "../../math/color";
import { selectedLight, selectLight } from "../../state/selection";
import { AddLightButton } from "../tree/AddLightButton";
import { Section } from "./Section";

interface LightsProps {
  readonly lights: Lights;
  readonly disabled: boolean;
}

export function ManualList({ lights }: LightsProps) {
  return (
    <Section title="Lights set by hand" action={<AddLightButton />}>
      {lights.manual.length === 0 && <p class="quiet small">None yet. Use + to add one.</p>}
      <div class="chips" role="group" aria-label="Light to edit">
        {lights.manual.map((light, index) => (
          <button
            key={index}
            type="button"
            class="chip"
            aria-pressed={selectedLight.value === index}
            onClick={() => selectLight(index)}
          >
            <i class="tree-color" style={{ background: hexFromLinear(light.color_linear) }} />
            {LIGHT_TYPES[light.type].label} {index + 1}
          </button>
        ))}
      </div>
    </Section>
  );
}
