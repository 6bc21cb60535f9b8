// Requests to the REST API; a refusal becomes one sentence.
import { room } from "./room";
import { token, tokenRefused } from "./session";
import type { Problem } from "./types";

/** Every route, for the first room. */
export const ROOT = "api/v1";
/** Every route, for the room that this page shows. */
export const API = room === null ? ROOT : apiOf(room);
const PROBLEM_PREFIX = "urn:deltalight:problem:";
const JSON_TYPE = "application/json";

/** Every route, for a room. */
export function apiOf(name: string): string {
  return `${ROOT}/rooms/${encodeURIComponent(name)}`;
}

/** A refusal: `message` is the sentence for people, `kind` the end of the problem's type. */
export class ProblemError extends Error {
  constructor(
    readonly status: number,
    readonly kind: string,
    message: string,
    readonly revision: number | null = null,
  ) {
    super(message);
  }

  get isStale(): boolean {
    return this.kind === "stale-revision";
  }
}

export interface RequestOptions {
  readonly body?: unknown;
  readonly type?: string;
  readonly ifMatch?: number | undefined;
  /** Of the bytes of a file, as HTTP names one. */
  readonly range?: string | undefined;
  /** Changes of one gesture are undone together. */
  readonly gesture?: string | undefined;
}

export async function request<T>(method: string, path: string, options: RequestOptions = {}): Promise<T> {
  const answer = await send(method, path, options);
  if (!answer.ok) throw refusal(answer.status, await answer.text());
  return (answer.status === 204 ? undefined : await answer.json()) as T;
}

export async function requestText(path: string): Promise<string> {
  const answer = await send("GET", path, {});
  const text = await answer.text();
  if (!answer.ok) throw refusal(answer.status, text);
  return text;
}

export async function requestBytes(path: string, range?: string): Promise<ArrayBuffer> {
  const answer = await send("GET", path, { range });
  if (!answer.ok) throw refusal(answer.status, await answer.text());
  return answer.arrayBuffer();
}

async function send(method: string, path: string, options: RequestOptions): Promise<Response> {
  const init: RequestInit = { method, headers: headersOf(options) };
  if (options.body !== undefined) init.body = encode(options);
  try {
    return await fetch(path, init);
  } catch {
    throw new ProblemError(
      0,
      "unreachable",
      "The server does not respond. Check that `deltalight api` is still running.",
    );
  }
}

function encode(options: RequestOptions): string {
  return options.type === undefined ? JSON.stringify(options.body) : String(options.body);
}

function headersOf(options: RequestOptions): Headers {
  const headers = authorization();
  if (options.body !== undefined) headers.set("Content-Type", options.type ?? JSON_TYPE);
  if (options.range !== undefined) headers.set("Range", options.range);
  if (options.ifMatch !== undefined) headers.set("If-Match", `"${options.ifMatch}"`);
  if (options.gesture !== undefined) headers.set("Deltalight-Gesture", options.gesture);
  return headers;
}

export function authorization(): Headers {
  const headers = new Headers();
  if (token.value !== null) headers.set("Authorization", `Bearer ${token.value}`);
  return headers;
}

/** Read a refusal; without a right token the sign-in page comes up too. */
export function refusal(status: number, text: string): ProblemError {
  let problem: Partial<Problem> = {};
  try {
    problem = JSON.parse(text) as Partial<Problem>;
  } catch {
    // whoever stands between answered: a proxy's page says nothing that people could use
  }
  const sentence = sentenceOf(problem.detail ?? `The server answered with status ${status}.`);
  if (status === 401) tokenRefused(sentence);
  return new ProblemError(status, (problem.type ?? "").replace(PROBLEM_PREFIX, ""), sentence, problem.revision ?? null);
}

/** A capital at the beginning, unless that is a name: a file's, a key's or an id's stays as it was typed. */
export function sentenceOf(detail: string): string {
  const isWord = /^[a-z]+[ ,]/.test(detail);
  return isWord ? detail.charAt(0).toUpperCase() + detail.slice(1) : detail;
}
