import type { SceneObject } from "../../api/types";
import { edit } from "../../state/gesture";
import { objectTarget } from "../../state/targets";
import { Field } from "../ui/Field";
import { NumberInput } from "../ui/NumberInput";
import { Select } from "../ui/Select";
import { Section } from "./Section";

interface FrameSectionProps {
  readonly item: SceneObject;
  readonly disabled: boolean;
}

/** What the object's pose is relative to, and which way its file is up. */
export function FrameSection({ item, disabled }: FrameSectionProps) {
  const target = objectTarget(item.id);
  const marker = item.frame.startsWith("marker:") ? Number(item.frame.slice("marker:".length)) : null;
  return (
    <Section title="Placement">
      <Field
        label="Anchor"
        help="Objects on the board stay put. An object on a marker moves with it, and can only be placed by its fields."
        inline
      >
        <Select
          label="Anchor"
          value={marker === null ? "world" : "marker"}
          choices={[
            { value: "world", label: "Board" },
            { value: "marker", label: "Marker" },
          ]}
          onChange={(frame) => edit(target, { frame: frame === "world" ? "world" : "marker:0" })}
          disabled={disabled}
        />
      </Field>
      {marker !== null && (
        <Field label="Marker" inline>
          <NumberInput
            label="Marker"
            value={marker}
            onChange={(id) => void edit(target, { frame: `marker:${id ?? 0}` })}
            min={0}
            step={1}
            integer
            disabled={disabled}
          />
        </Field>
      )}
      <Field label="Up axis" help="glTF files are y-up; other formats are assumed to be z-up." inline>
        <Select
          label="Up axis"
          value={item.up_axis ?? "auto"}
          choices={[
            { value: "auto", label: "Default for the format" },
            { value: "y", label: "Y" },
            { value: "z", label: "Z" },
          ]}
          onChange={(axis) => edit(target, { up_axis: axis === "auto" ? null : axis })}
          disabled={disabled}
        />
      </Field>
    </Section>
  );
}
