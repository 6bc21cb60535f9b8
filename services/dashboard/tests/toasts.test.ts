import { beforeEach, describe, expect, it, vi } from "vitest";
import { dismiss, hold, release, toast, toasts } from "../src/state/toasts";

const texts = (): string[] => toasts.value.map((each) => each.text);

describe("messages", () => {
  beforeEach(() => {
    vi.useFakeTimers();
    for (const { id } of toasts.value) dismiss(id);
  });

  it("leave by themselves, refusals later than notices", () => {
    toast("a notice");
    toast("a refusal", "error");
    vi.advanceTimersByTime(4000);
    expect(texts()).toEqual(["a notice", "a refusal"]);
    vi.advanceTimersByTime(4000);
    expect(texts()).toEqual(["a refusal"]);
    vi.advanceTimersByTime(8000);
    expect(texts()).toEqual([]);
  });

  it("stay while somebody points at them, and for as long as they take to read", () => {
    toast("a notice");
    hold(toasts.value[0]!);
    vi.advanceTimersByTime(60_000);
    expect(texts()).toEqual(["a notice"]);
    release(toasts.value[0]!);
    vi.advanceTimersByTime(8000);
    expect(texts()).toEqual([]);
    toast("long ".repeat(100));
    vi.advanceTimersByTime(20_000);
    expect(toasts.value).toHaveLength(1);
  });

  it("begin anew when they are told again", () => {
    toast("a notice");
    vi.advanceTimersByTime(4000);
    toast("a notice");
    vi.advanceTimersByTime(4000);
    expect(texts()).toEqual(["a notice"]);
  });
});
