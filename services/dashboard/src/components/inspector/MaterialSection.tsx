import type { Material, SceneObject } from "../../api/types";
import { MATERIALS } from "../../forms/materials";
import { schemas } from "../../forms/schemas";
import { assetName, assets, materialOfFile } from "../../state/assets";
import { edit } from "../../state/gesture";
import { objectTarget } from "../../state/targets";
import { Button } from "../ui/Button";
import { ColorField } from "../ui/ColorField";
import { Field } from "../ui/Field";
import { Select } from "../ui/Select";
import { SliderField } from "../ui/SliderField";
import { Switch } from "../ui/Switch";
import { useGesture } from "../ui/useGesture";
import { Section } from "./Section";

interface MaterialSectionProps {
  readonly item: SceneObject;
  readonly disabled: boolean;
}

/** The material of the scene, in place of the file's: in numbers, or an asset. */
export function MaterialSection({ item, disabled }: MaterialSectionProps) {
  const material = item.material ?? null;
  const target = objectTarget(item.id);
  const isOwn = material !== null && !("precomputed" in material);
  const precomputed = material !== null && "precomputed" in material ? material.precomputed : "";
  const measured = assets.value.filter((each) => each.kind === "material");
  return (
    <Section title="Material">
      {measured.length > 0 && (
        <Field
          label="Measured"
          help="Paints and texture maps made by `deltalight precompute` and uploaded under Assets."
          inline
        >
          <Select
            label="Measured material"
            value={precomputed}
            choices={[
              { value: "", label: "None" },
              ...measured.map((each) => ({ value: each.asset, label: assetName(each) })),
            ]}
            onChange={(chosen) => edit(target, { material: chosen ? { precomputed: chosen } : null })}
            disabled={disabled}
          />
        </Field>
      )}
      <Switch
        label="Override material"
        checked={isOwn}
        disabled={disabled}
        onChange={(own) => edit(target, { material: own ? materialOfFile(item, assets.value) : null })}
      />
      {isOwn && <MaterialFields item={item} material={material} disabled={disabled} />}
    </Section>
  );
}

interface MaterialFieldsProps extends MaterialSectionProps {
  readonly material: Material;
}

function MaterialFields({ item, material, disabled }: MaterialFieldsProps) {
  const gesture = useGesture(objectTarget(item.id));
  const push = (change: Partial<Material>): void => gesture.push({ material: change });
  const help = (key: keyof Material): string => schemas.value.Material?.properties?.[key]?.description ?? "";
  const shares = ["roughness", "metallic", "specular", "transmission"] as const;
  return (
    <>
      <div class="presets" role="group" aria-label="Material presets">
        {MATERIALS.map(({ label, material: change }) => (
          <Button
            key={label}
            disabled={disabled}
            onClick={() => edit(objectTarget(item.id), { material: { ...material, ...change } })}
          >
            {label}
          </Button>
        ))}
      </div>
      <ColorField
        label="Base colour"
        value={material.base_color}
        onChange={(base_color) => push({ base_color })}
        onEnd={gesture.end}
        max={1}
        help={help("base_color")}
        disabled={disabled}
      />
      {shares.map((key) => (
        <SliderField
          key={key}
          label={key.charAt(0).toUpperCase() + key.slice(1)}
          value={material[key]}
          onChange={(value) => push({ [key]: value })}
          onEnd={gesture.end}
          min={0}
          max={1}
          help={help(key)}
          disabled={disabled}
        />
      ))}
      <ColorField
        label="Emission"
        value={material.emission}
        onChange={(emission) => push({ emission })}
        onEnd={gesture.end}
        max={1000}
        help={help("emission")}
        disabled={disabled}
      />
    </>
  );
}
