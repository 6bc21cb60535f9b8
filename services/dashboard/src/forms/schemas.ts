// The JSON Schemas of the service's own OpenAPI document, from which forms are made.
import { signal } from "@preact/signals";
import { request } from "../api/http";

export interface JsonSchema {
  readonly type?: string;
  readonly description?: string;
  readonly default?: unknown;
  readonly const?: unknown;
  readonly enum?: readonly unknown[];
  readonly minimum?: number;
  readonly maximum?: number;
  readonly exclusiveMinimum?: number;
  readonly exclusiveMaximum?: number;
  readonly multipleOf?: number;
  readonly anyOf?: readonly JsonSchema[];
  readonly oneOf?: readonly JsonSchema[];
  readonly properties?: Readonly<Record<string, JsonSchema>>;
  readonly $ref?: string;
}

interface OpenApi {
  readonly components: { readonly schemas: Readonly<Record<string, JsonSchema>> };
}

export const schemas = signal<Readonly<Record<string, JsonSchema>>>({});

export async function readSchemas(): Promise<void> {
  if (Object.keys(schemas.value).length > 0) return;
  schemas.value = (await request<OpenApi>("GET", "openapi.json")).components.schemas;
}
