import { Field } from "../components/ui/Field";
import { NumberInput } from "../components/ui/NumberInput";
import { Select } from "../components/ui/Select";
import { Switch } from "../components/ui/Switch";
import type { SchemaField } from "./fields";

export type Values = Readonly<Partial<Record<string, unknown>>>;

interface SchemaFormProps {
  readonly fields: readonly SchemaField[];
  readonly values: Values;
  readonly onChange: (key: string, value: unknown) => void;
  readonly onEnd?: () => void;
  readonly disabled: boolean;
}

const AUTOMATIC = "automatic";

/** The fields of a schema with the values that they have. */
export function SchemaForm({ fields, values, onChange, onEnd, disabled }: SchemaFormProps) {
  return (
    <div class="form">
      {fields.map((field) => (
        <Field key={field.key} label={field.label} help={field.help} inline>
          <Control
            field={field}
            value={values[field.key] ?? null}
            onChange={(value) => onChange(field.key, value)}
            disabled={disabled}
            {...(onEnd ? { onEnd } : {})}
          />
        </Field>
      ))}
    </div>
  );
}

interface ControlProps {
  readonly field: SchemaField;
  readonly value: unknown;
  readonly onChange: (value: unknown) => void;
  readonly onEnd?: () => void;
  readonly disabled: boolean;
}

function Control({ field, value, onChange, onEnd, disabled }: ControlProps) {
  if (field.kind === "number") {
    return (
      <NumberInput
        label={field.label}
        value={typeof value === "number" ? value : null}
        onChange={onChange}
        min={field.min}
        max={field.max}
        step={field.step}
        integer={field.isInteger}
        disabled={disabled}
        {...(field.unit ? { unit: field.unit } : {})}
        {...(field.isNullable ? { empty: AUTOMATIC } : {})}
        {...(onEnd ? { onEnd } : {})}
      />
    );
  }
  if (field.kind === "switch" && !field.isNullable) {
    return <Switch label="" name={field.label} checked={value === true} onChange={onChange} disabled={disabled} />;
  }
  return <ChoiceControl field={field} value={value} onChange={onChange} disabled={disabled} />;
}

function ChoiceControl({ field, value, onChange, disabled }: Omit<ControlProps, "onEnd">) {
  const known: readonly (string | number | boolean)[] = field.kind === "choice" ? field.choices : [true, false];
  const choices = known.map((each) => ({ value: String(each), label: wordOf(each) }));
  const all = field.isNullable ? [{ value: AUTOMATIC, label: AUTOMATIC }, ...choices] : choices;
  return (
    <Select
      label={field.label}
      value={known.find((each) => each === value)?.toString() ?? AUTOMATIC}
      choices={all}
      onChange={(chosen) => onChange(known.find((each) => String(each) === chosen) ?? null)}
      disabled={disabled}
    />
  );
}

function wordOf(value: string | number | boolean): string {
  if (typeof value === "boolean") return value ? "yes" : "no";
  return String(value).replaceAll("_", " ");
}
