import type { ManualLight } from "../../api/types";
import { directionFromAngles, anglesFromDirection } from "../../math/direction";
import type { Patch } from "../../state/targets";
import { Field } from "../ui/Field";
import { NumberInput } from "../ui/NumberInput";
import { SliderField } from "../ui/SliderField";
import { VectorInput } from "../ui/VectorInput";

interface LightFieldsProps {
  readonly light: ManualLight;
  readonly onChange: (patch: Patch) => void;
  readonly onEnd: () => void;
  readonly disabled: boolean;
}

interface Strength {
  readonly key: "intensity" | "irradiance" | "radiance";
  readonly label: string;
  readonly unit: string;
  readonly help: string;
  readonly max: number;
}

const STRENGTHS: readonly Strength[] = [
  {
    key: "intensity",
    label: "Intensity",
    unit: "m²",
    max: 20,
    help: "Camera units times square metres: a surface at distance d gets intensity / d².",
  },
  {
    key: "irradiance",
    label: "Irradiance",
    unit: "",
    max: 10,
    help: "Camera units, measured perpendicular to the beam.",
  },
  {
    key: "radiance",
    label: "Radiance",
    unit: "",
    max: 10,
    help: "Camera units: 1 is sensor white at the reference exposure.",
  },
];

/** Strength, place, direction and size, as far as the kind of light has them. */
export function LightFields({ light, onChange, onEnd, disabled }: LightFieldsProps) {
  const values = light as unknown as Readonly<Record<string, unknown>>;
  const common = { onEnd, disabled };
  const strength = STRENGTHS.find(({ key }) => key in light)!;
  return (
    <>
      <SliderField
        label={strength.label}
        help={strength.help}
        value={values[strength.key] as number}
        onChange={(value) => onChange({ [strength.key]: value })}
        min={0}
        max={strength.max}
        numberMax={1e9}
        step={0.05}
        {...(strength.unit ? { unit: strength.unit } : {})}
        {...common}
      />
      {"position_m" in light && (
        <VectorInput
          label="Position"
          unit="m"
          value={light.position_m}
          onChange={(position_m) => onChange({ position_m })}
          {...common}
        />
      )}
      {"direction" in light && <DirectionFields light={light} onChange={onChange} {...common} />}
      {"axis_u_m" in light && (
        <>
          <VectorInput
            label="First edge"
            unit="m"
            value={light.axis_u_m}
            onChange={(axis_u_m) => onChange({ axis_u_m })}
            {...common}
          />
          <VectorInput
            label="Second edge"
            unit="m"
            help="It shines in the direction of first edge × second edge."
            value={light.axis_v_m}
            onChange={(axis_v_m) => onChange({ axis_v_m })}
            {...common}
          />
        </>
      )}
      {"radius_m" in light && (
        <Field label="Radius" help="Larger lamps cast softer shadows." inline>
          <NumberInput
            label="Radius"
            unit="m"
            value={light.radius_m}
            onChange={(radius_m) => onChange({ radius_m })}
            min={0}
            max={100}
            {...common}
          />
        </Field>
      )}
      {"angle_deg" in light && (
        <>
          <SliderField
            label="Cone angle"
            unit="°"
            value={light.angle_deg}
            onChange={(angle_deg) => onChange({ angle_deg })}
            min={1}
            max={179}
            step={1}
            {...common}
          />
          <SliderField
            label="Soft edge"
            value={light.blend}
            onChange={(blend) => onChange({ blend })}
            min={0}
            max={1}
            {...common}
          />
        </>
      )}
      {"angular_radius_deg" in light && (
        <SliderField
          label="Angular radius"
          unit="°"
          help="The sun's is 0.27°."
          value={light.angular_radius_deg}
          onChange={(angular_radius_deg) => onChange({ angular_radius_deg })}
          min={0}
          max={20}
          numberMax={90}
          step={0.1}
          {...common}
        />
      )}
    </>
  );
}

type Directed = Extract<ManualLight, { direction: unknown }>;

/** Where the light comes from: a bearing and a height over the board's plane. */
function DirectionFields({
  light,
  onChange,
  onEnd,
  disabled,
}: Omit<LightFieldsProps, "light"> & { readonly light: Directed }) {
  const [bearing, height] = anglesFromDirection(light.direction);
  return (
    <>
      <SliderField
        label="Direction"
        unit="°"
        help="Direction that the light comes from, as an angle on the board: 0° is the right edge, 90° the top edge."
        value={bearing}
        onChange={(next) => onChange({ direction: directionFromAngles(next, height) })}
        min={-180}
        max={180}
        step={1}
        onEnd={onEnd}
        disabled={disabled}
      />
      <SliderField
        label="Elevation"
        unit="°"
        help="Angle above the plane of the board; 90° is directly overhead."
        value={height}
        onChange={(next) => onChange({ direction: directionFromAngles(bearing, next) })}
        min={-90}
        max={90}
        step={1}
        onEnd={onEnd}
        disabled={disabled}
      />
    </>
  );
}
