import { role } from "../../api/session";
import type { MethodName } from "../../api/types";
import { fieldsOf, type SchemaField } from "../../forms/fields";
import { methods, methodText } from "../../forms/methods";
import { SchemaForm } from "../../forms/SchemaForm";
import { schemas } from "../../forms/schemas";
import { setMethod } from "../../state/actions";
import { edit } from "../../state/gesture";
import { sceneDocument } from "../../state/scene";
import { partTarget } from "../../state/targets";
import { Button } from "../ui/Button";
import { useGesture } from "../ui/useGesture";
import { Section } from "./Section";

export function MethodPanel() {
  const method = sceneDocument.value?.method;
  const gesture = useGesture(partTarget("method"));
  if (!method) return null;
  const disabled = role.value !== "control";
  const { schema, main } = methodText(method.name);
  const fields = fieldsOf(schemas.value[schema]);
  const others = fields.filter(({ key }) => !main.includes(key));
  const form = (shown: readonly SchemaField[]) => (
    <SchemaForm
      fields={shown}
      values={method}
      onChange={(key, value) => gesture.push({ [key]: value })}
      onEnd={gesture.end}
      disabled={disabled}
    />
  );
  const defaults = () => edit(partTarget("method"), Object.fromEntries(fields.map(({ key }) => [key, null])));
  return (
    <>
      <Section title="Relighting method">
        <MethodChoice value={method.name} disabled={disabled} />
      </Section>
      {fields.length > 0 && (
        <Section title="Settings">
          {form(main.flatMap((key) => fields.find((field) => field.key === key) ?? []))}
          {others.length > 0 && (
            <details class="more">
              <summary>{others.length} more settings</summary>
              {form(others)}
            </details>
          )}
          <Button onClick={defaults} disabled={disabled}>
            Reset to defaults
          </Button>
        </Section>
      )}
    </>
  );
}

function MethodChoice({ value, disabled }: { readonly value: MethodName; readonly disabled: boolean }) {
  return (
    <div class="choices" role="radiogroup" aria-label="Method">
      {methods.value.map((each) => (
        <label key={each.name} class="choice">
          <input
            type="radio"
            name="method"
            aria-label={each.title}
            aria-describedby={`method-${each.name}`}
            checked={each.name === value}
            disabled={disabled}
            onChange={() => void setMethod(each.name)}
          />
          <span>
            <b>{each.title}</b> <code>{each.name}</code>
            <span class="quiet small" id={`method-${each.name}`}>
              {each.help}
            </span>
          </span>
        </label>
      ))}
    </div>
  );
}
