import { role } from "../../api/session";
import type { Surface } from "../../api/types";
import { assetName, assets } from "../../state/assets";
import { edit } from "../../state/gesture";
import { sceneDocument } from "../../state/scene";
import { partTarget } from "../../state/targets";
import { Button } from "../ui/Button";
import { Field } from "../ui/Field";
import { NumberInput } from "../ui/NumberInput";
import { Select } from "../ui/Select";
import { Section } from "./Section";
import { SurfaceSection } from "./SurfaceSection";

const MOST_SURFACES = 16;

/** Shape of the real scene, and which of its surfaces shine. */
export function RealPanel() {
  const real = sceneDocument.value?.real;
  if (!real) return null;
  const disabled = role.value !== "control";
  const target = partTarget("real");
  const surfaces = real.surfaces;
  const add = () => edit(target, { surfaces: [...surfaces, { region: { plane: {} }, roughness: 0.25 }] });
  const change = (index: number, surface: Surface | null) =>
    edit(target, { surfaces: surfaces.flatMap((each, at) => (at === index ? (surface ?? []) : each)) });
  return (
    <>
      <Section title="Real geometry">
        <GeometryField geometry={real.geometry} disabled={disabled} />
        <Field
          label="Unseen albedo"
          help="Albedo of surfaces that the camera does not currently see. Automatic uses what it saw before."
          inline
        >
          <NumberInput
            label="Unseen albedo"
            value={real.unseen_albedo ?? null}
            onChange={(unseen_albedo) => void edit(target, { unseen_albedo })}
            min={0}
            max={0.95}
            empty="automatic"
            disabled={disabled}
          />
        </Field>
      </Section>
      {surfaces.map((surface, index) => (
        <SurfaceSection
          key={index}
          index={index}
          surface={surface}
          onChange={(next) => change(index, next)}
          disabled={disabled}
        />
      ))}
      <div class="section">
        <p class="quiet small">
          Real surfaces are assumed to be matte. Declare those that are glossy, such as a polished table.
        </p>
        <Button icon="add" onClick={add} disabled={disabled || surfaces.length >= MOST_SURFACES}>
          Declare a surface
        </Button>
      </div>
    </>
  );
}

function GeometryField({ geometry, disabled }: { readonly geometry: unknown; readonly disabled: boolean }) {
  const meshes = assets.value.filter((each) => each.kind === "mesh");
  const model = typeof geometry === "object" && geometry !== null ? (geometry as { model: string }).model : null;
  const choices = [
    { value: "depth", label: "Depth of each frame" },
    { value: "fused", label: "Depth of all frames" },
    ...meshes.map((each) => ({ value: each.asset, label: `Model: ${assetName(each)}` })),
  ];
  const choose = (value: string) =>
    edit(partTarget("real"), { geometry: value === "depth" || value === "fused" ? value : { model: value } });
  return (
    <Field label="Geometry" help="The depth of each frame, the fused depth of all frames, or a given model." inline>
      <Select
        label="Geometry"
        value={model ?? String(geometry)}
        choices={choices}
        onChange={choose}
        disabled={disabled}
      />
    </Field>
  );
}
