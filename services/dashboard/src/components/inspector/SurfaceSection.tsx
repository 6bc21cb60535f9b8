import type { Surface, Vector } from "../../api/types";
import { Field } from "../ui/Field";
import { IconButton } from "../ui/IconButton";
import { NumberInput } from "../ui/NumberInput";
import { SliderField } from "../ui/SliderField";
import { VectorInput } from "../ui/VectorInput";
import { Section } from "./Section";

interface SurfaceSectionProps {
  readonly index: number;
  readonly surface: Surface;
  /** null takes it out. */
  readonly onChange: (surface: Surface | null) => unknown;
  readonly disabled: boolean;
}

/** One declared surface of the real scene: where it is and how it shines. */
export function SurfaceSection({ index, surface, onChange, disabled }: SurfaceSectionProps) {
  const { plane, box, sheet, material } = surface.region ?? {};
  const set = (values: Partial<Surface>): void => void onChange({ ...surface, ...values });
  const setPlane = (values: { point_m?: Vector; normal?: Vector; tolerance_m?: number }): void => {
    if (plane) set({ region: { plane: { ...plane, ...values } } });
  };
  return (
    <Section
      title={`Surface ${index + 1}`}
      action={
        <IconButton
          icon="trash"
          label={`Remove surface ${index + 1}`}
          disabled={disabled}
          onClick={() => onChange(null)}
        />
      }
    >
      {plane && (
        <>
          <VectorInput
            label="Point on the plane"
            unit="m"
            value={plane.point_m}
            onChange={(point_m) => setPlane({ point_m })}
            disabled={disabled}
          />
          <VectorInput
            label="Normal"
            value={plane.normal}
            onChange={(normal) => setPlane({ normal })}
            disabled={disabled}
          />
          <Field label="Thickness" help="Points closer to the plane than this belong to the surface." inline>
            <NumberInput
              label="Thickness"
              unit="m"
              value={plane.tolerance_m}
              onChange={(tolerance_m) => tolerance_m !== null && setPlane({ tolerance_m })}
              min={0.001}
              max={100}
              disabled={disabled}
            />
          </Field>
        </>
      )}
      {box && (
        <>
          <VectorInput
            label="Lower corner"
            unit="m"
            value={box.min_m}
            onChange={(min_m) => set({ region: { box: { ...box, min_m } } })}
            disabled={disabled}
          />
          <VectorInput
            label="Upper corner"
            unit="m"
            value={box.max_m}
            onChange={(max_m) => set({ region: { box: { ...box, max_m } } })}
            disabled={disabled}
          />
        </>
      )}
      {material && <p class="quiet small">Material “{material}” of the given model</p>}
      {sheet && <p class="quiet small">A matte sheet on the board's plane</p>}
      {!sheet &&
        (["roughness", "metallic", "specular"] as const).map((key) => (
          <SliderField
            key={key}
            label={key.charAt(0).toUpperCase() + key.slice(1)}
            value={surface[key]}
            onChange={(value) => set({ [key]: value })}
            min={0}
            max={1}
            disabled={disabled}
          />
        ))}
    </Section>
  );
}
