// Sentences that leave by themselves once they were read, and short ones for screen readers.
import { signal } from "@preact/signals";
import { ProblemError } from "../api/http";

export interface Toast {
  readonly id: number;
  readonly kind: "error" | "notice";
  readonly text: string;
}

const MOST = 4;
// Time to notice one, and to read it at 15 letters a second; refusals want a second look.
const STAYS_MS = { notice: 5000, error: 10_000 };
const LETTER_MS = 1000 / 15;
let count = 0;
const leaving = new Map<number, ReturnType<typeof setTimeout>>();

export const toasts = signal<readonly Toast[]>([]);
/** Read out by screen readers; not shown. */
export const announcement = signal("");

export function toast(text: string, kind: Toast["kind"] = "notice"): void {
  const others = toasts.value.filter((each) => each.text !== text);
  const made: Toast = { id: ++count, kind, text };
  toasts.value = [...others, made].slice(-MOST);
  release(made);
}

/** Keep one for as long as somebody points at it. */
export function hold({ id }: Toast): void {
  clearTimeout(leaving.get(id));
  leaving.delete(id);
}

/** Let one leave after its time. */
export function release(shown: Toast): void {
  hold(shown);
  const stays = STAYS_MS[shown.kind] + LETTER_MS * shown.text.length;
  leaving.set(
    shown.id,
    setTimeout(() => dismiss(shown.id), stays),
  );
}

export function dismiss(id: number): void {
  clearTimeout(leaving.get(id));
  leaving.delete(id);
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
  toast("Something went wrong in this page. Reload it if it misbehaves.", "error");
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
