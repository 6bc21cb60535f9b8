import type { Animation, SceneObject } from "../../api/types";
import { schemas } from "../../forms/schemas";
import { trimmed } from "../../math/units";
import { assets } from "../../state/assets";
import { edit } from "../../state/gesture";
import { objectTarget } from "../../state/targets";
import { Field } from "../ui/Field";
import { NumberInput } from "../ui/NumberInput";
import { Select } from "../ui/Select";
import { Switch } from "../ui/Switch";
import { useGesture } from "../ui/useGesture";
import { Section } from "./Section";

interface AnimationSectionProps {
  readonly item: SceneObject;
  readonly disabled: boolean;
}

interface Clip {
  readonly name: string;
  readonly duration_s: number;
}

const AT_REST = "rest";

/** Which of its file's clips an object plays; nothing for files without any. */
export function AnimationSection({ item, disabled }: AnimationSectionProps) {
  const gesture = useGesture(objectTarget(item.id));
  const clips = clipsOf(item);
  if (clips.length === 0) return null;
  const animation = item.animation ?? null;
  const push = (change: Partial<Animation>): void => gesture.push({ animation: change });
  const help = (key: keyof Animation): string | undefined => schemas.value.Animation?.properties?.[key]?.description;
  const choose = (value: string) =>
    edit(
      objectTarget(item.id),
      value === AT_REST ? { animation: null, rigid: true } : { animation: { clip: Number(value) }, rigid: false },
    );
  return (
    <Section title="Animation">
      <Field label="Clip" inline>
        <Select
          label="Clip"
          value={animation ? String(indexOf(animation, clips)) : AT_REST}
          choices={[
            { value: AT_REST, label: "None" },
            ...clips.map((clip, index) => ({
              value: String(index),
              label: `${clip.name || index} (${trimmed(clip.duration_s, 1)} s)`,
            })),
          ]}
          onChange={choose}
          disabled={disabled}
        />
      </Field>
      {animation && (
        <>
          <Field label="Speed" help={help("speed")} inline>
            <NumberInput
              label="Speed"
              unit="×"
              value={animation.speed}
              onChange={(speed) => speed !== null && push({ speed })}
              onEnd={gesture.end}
              step={0.1}
              disabled={disabled}
            />
          </Field>
          <Switch label="Loop" checked={animation.loop} onChange={(loop) => push({ loop })} disabled={disabled} />
        </>
      )}
    </Section>
  );
}

function clipsOf(item: SceneObject): readonly Clip[] {
  const clips = assets.value.find((each) => each.asset === item.asset)?.facts.clips;
  return Array.isArray(clips) ? (clips as Clip[]) : [];
}

function indexOf({ clip }: Animation, clips: readonly Clip[]): number {
  if (typeof clip === "number") return clip;
  return Math.max(
    0,
    clips.findIndex((each) => each.name === clip),
  );
}
