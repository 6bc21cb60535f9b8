import type { Lights } from "../../api/types";
import { schemas } from "../../forms/schemas";
import { edit } from "../../state/gesture";
import { partTarget } from "../../state/targets";
import { Field } from "../ui/Field";
import { Select } from "../ui/Select";
import { Section } from "./Section";

interface RegistrationSectionProps {
  readonly lights: Lights;
  readonly disabled: boolean;
}

type Choice = "default" | "auto" | "given";

/** How the strength of the lights meets the camera's. */
export function RegistrationSection({ lights, disabled }: RegistrationSectionProps) {
  const registration = lights.registration ?? null;
  const value: Choice = registration === null ? "default" : registration === "auto" ? "auto" : "given";
  const help = (key: string): string | undefined => schemas.value.Lights?.properties?.[key]?.description;
  const choose = (choice: Choice) =>
    edit(partTarget("lights"), { registration: { default: null, auto: "auto", given: [1, 1, 1] }[choice] });
  return (
    <Section title="Match to the camera">
      <Field label="Strength" help={help("registration")} inline>
        <Select
          label="Strength"
          value={value}
          choices={[
            { value: "default", label: "Default for the source" },
            { value: "auto", label: "From the picture" },
            { value: "given", label: "As given" },
          ]}
          onChange={choose}
          disabled={disabled}
        />
      </Field>
      {(lights.mode === "manual" || lights.mode === "tracked") && (
        <Field label="Surroundings" help={help("surroundings")} inline>
          <Select
            label="Surroundings"
            value={lights.surroundings}
            choices={[
              { value: "auto", label: "Estimated" },
              { value: "none", label: "Dark" },
            ]}
            onChange={(surroundings) => edit(partTarget("lights"), { surroundings })}
            disabled={disabled}
          />
        </Field>
      )}
    </Section>
  );
}
