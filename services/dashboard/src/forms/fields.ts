// Controls that a JSON Schema asks for: choices, switches and numbers; anything else has a form of its own.
import { labelOf, unitOf } from "../math/units";
import type { JsonSchema } from "./schemas";

interface FieldBase {
  readonly key: string;
  readonly label: string;
  readonly help: string;
  readonly unit: string;
  /** null is a value of its own: "automatic". */
  readonly isNullable: boolean;
  readonly initial: unknown;
}

export interface ChoiceField extends FieldBase {
  readonly kind: "choice";
  readonly choices: readonly (string | number)[];
}

export interface SwitchField extends FieldBase {
  readonly kind: "switch";
}

export interface NumberField extends FieldBase {
  readonly kind: "number";
  readonly min: number | undefined;
  readonly max: number | undefined;
  readonly step: number;
  readonly isInteger: boolean;
}

export type SchemaField = ChoiceField | SwitchField | NumberField;

/** Fields of a schema's simple properties, in their order. */
export function fieldsOf(schema: JsonSchema | undefined): SchemaField[] {
  return Object.entries(schema?.properties ?? {}).flatMap(([key, property]) => fieldOf(key, property) ?? []);
}

export function fieldOf(key: string, property: JsonSchema): SchemaField | null {
  const options = property.anyOf ?? [property];
  const inner = options.find((each) => each.type !== "null");
  if (!inner || inner.const !== undefined) return null;
  const base: FieldBase = {
    key,
    label: labelOf(key),
    help: property.description ?? inner.description ?? "",
    unit: unitOf(key),
    isNullable: options.length > 1,
    initial: property.default ?? null,
  };
  if (inner.enum) return { ...base, kind: "choice", choices: inner.enum as (string | number)[] };
  if (inner.type === "boolean") return { ...base, kind: "switch" };
  if (inner.type === "integer" || inner.type === "number") return numberField(base, inner);
  return null;
}

function numberField(base: FieldBase, schema: JsonSchema): NumberField {
  const isInteger = schema.type === "integer";
  return {
    ...base,
    kind: "number",
    min: schema.minimum ?? schema.exclusiveMinimum,
    max: schema.maximum ?? schema.exclusiveMaximum,
    step: schema.multipleOf ?? (isInteger ? 1 : 0.01),
    isInteger,
  };
}
