// Sentences that stay until they are dismissed, and short ones for screen readers.
import { signal } from "@preact/signals";
import { ProblemError } from "../api/http";

export interface Toast {
  readonly id: number;
  readonly kind: "error" | "notice";
  readonly text: string;
}

const MOST = 4;
let count = 0;

export const toasts = signal<readonly Toast[]>([]);
/** Read out by screen readers; not shown. */
export const announcement = signal("");

export function toast(text: string, kind: Toast["kind"] = "notice"): void {
  const others = toasts.value.filter((each) => each.text !== text);
  toasts.value = [...others, { id: ++count, kind, text }].slice(-MOST);
}

export function dismiss(id: number): void {
  toasts.value = toasts.value.filter((each) => each.id !== id);
}

export function announce(text: string): void {
  announcement.value = text;
}

/** Tell a failure; what is no refusal of the service is a fault of this page. */
export function tell(fault: unknown): void {
  if (fault instanceof ProblemError) {
    if (fault.status !== 401) toast(fault.message, "error");
    return;
  }
  toast("Something in this page went wrong; load it again if it does not behave.", "error");
  console.error(fault);
}

/** The result of an action, or undefined after its failure was told. */
export async function attempt<T>(action: () => Promise<T>): Promise<T | undefined> {
  try {
    return await action();
  } catch (fault) {
    tell(fault);
    return undefined;
  }
}
