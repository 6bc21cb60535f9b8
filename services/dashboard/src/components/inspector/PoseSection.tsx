import type { Pose, SceneObject } from "../../api/types";
import { anglesFromQuaternion, quaternionFromAngles } from "../../math/rotation";
import { objectTarget } from "../../state/targets";
import { leansWithSurfaces, standsOnSurfaces } from "../../state/preferences";
import { draft } from "../../state/tools";
import { Button } from "../ui/Button";
import { Field } from "../ui/Field";
import { NumberInput } from "../ui/NumberInput";
import { Switch } from "../ui/Switch";
import { useGesture } from "../ui/useGesture";
import { VectorInput } from "../ui/VectorInput";
import { Section } from "./Section";

interface PoseSectionProps {
  readonly item: SceneObject;
  readonly disabled: boolean;
}

/** Position in metres, turn in degrees, scale: every action of the gizmo, by numbers. */
export function PoseSection({ item, disabled }: PoseSectionProps) {
  const gesture = useGesture(objectTarget(item.id));
  const dragged = draft.value?.id === item.id ? draft.value.pose : null;
  const pose = dragged ?? item.pose;
  const push = (change: Partial<Pose>): void => gesture.push({ pose: change });
  const upright = (): void => {
    const [, , yaw] = anglesFromQuaternion(pose.rotation_wxyz);
    push({ rotation_wxyz: quaternionFromAngles([0, 0, yaw]) });
    gesture.end();
  };
  return (
    <Section
      title="Pose"
      action={
        <Button kind="plain" disabled={disabled} onClick={upright}>
          Stand upright
        </Button>
      }
    >
      <VectorInput
        label="Position"
        unit="m"
        help="Position of the object's origin in the board's frame: x right, y up the sheet, z out of the paper."
        value={pose.translation_m}
        onChange={(translation_m) => push({ translation_m })}
        onEnd={gesture.end}
        disabled={disabled}
      />
      <VectorInput
        label="Rotation"
        unit="°"
        help="Rotations about x, then y, then z; z is up."
        value={anglesFromQuaternion(pose.rotation_wxyz)}
        onChange={(angles) => push({ rotation_wxyz: quaternionFromAngles(angles) })}
        onEnd={gesture.end}
        step={1}
        decimals={1}
        disabled={disabled}
      />
      <Field
        label="Lean with surfaces"
        help="On: the object tilts with slopes and walls as you drag or place it. Off: it keeps its rotation and stands only on surfaces that are not too steep."
        inline
      >
        <Switch
          label=""
          name="Lean with surfaces"
          checked={leansWithSurfaces.value}
          disabled={disabled || !standsOnSurfaces.value}
          onChange={(leans) => (leansWithSurfaces.value = leans)}
        />
      </Field>
      <Field label="Scale" inline>
        <NumberInput
          label="Scale"
          value={pose.scale}
          onChange={(scale) => scale !== null && push({ scale })}
          onEnd={gesture.end}
          min={0.0001}
          max={10000}
          step={0.05}
          unit="×"
          disabled={disabled}
        />
      </Field>
    </Section>
  );
}
