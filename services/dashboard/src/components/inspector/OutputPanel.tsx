import { role } from "../../api/session";
import { fieldsOf } from "../../forms/fields";
import { SchemaForm } from "../../forms/SchemaForm";
import { schemas } from "../../forms/schemas";
import { VIEWS } from "../../forms/views";
import { sceneDocument, setView, shownView } from "../../state/scene";
import { partTarget } from "../../state/targets";
import { useGesture } from "../ui/useGesture";
import { Section } from "./Section";

export function OutputPanel() {
  const output = sceneDocument.value?.output;
  const gesture = useGesture(partTarget("output"));
  if (!output) return null;
  const disabled = role.value !== "control";
  const fields = fieldsOf(schemas.value.Output).filter(({ key }) => key !== "view");
  return (
    <>
      <Section title="View">
        <div class="choices" role="radiogroup" aria-label="View">
          {VIEWS.map((each, index) => (
            <label key={each.value} class="choice">
              <input
                type="radio"
                name="view"
                aria-label={each.label}
                checked={each.value === shownView.value}
                onChange={() => setView(each.value)}
              />
              <span>
                <b>{each.label}</b>
                <span class="quiet small">{each.help}</span>
              </span>
              <kbd>{index + 1}</kbd>
            </label>
          ))}
        </div>
      </Section>
      <Section title="Picture">
        <SchemaForm
          fields={fields}
          values={output}
          onChange={(key, value) => gesture.push({ [key]: value })}
          onEnd={gesture.end}
          disabled={disabled}
        />
      </Section>
    </>
  );
}
