// Who this browser is to the service: its token, kept for as long as the tab is open.
import { signal } from "@preact/signals";

const TOKEN_KEY = "deltalight.token";

export type Phase = "starting" | "sign-in" | "ready" | "unreachable";

export const phase = signal<Phase>("starting");
export const token = signal<string | null>(sessionStorage.getItem(TOKEN_KEY));
export const signInProblem = signal<string>("");
/** "view" may only look; null until the service tells, when its events begin. */
export const role = signal<"view" | "control" | null>(null);
export const version = signal<string>("");

export function keepToken(value: string | null): void {
  token.value = value;
  if (value === null) sessionStorage.removeItem(TOKEN_KEY);
  else sessionStorage.setItem(TOKEN_KEY, value);
}

/** A request was refused for want of a right token. */
export function tokenRefused(sentence: string): void {
  if (token.value !== null) signInProblem.value = sentence; // several requests may be refused, only one has a reason
  keepToken(null);
  phase.value = "sign-in";
}
