import { describe, expect, it, vi } from "vitest";
import { delayFigures, delayText } from "../src/live/delay";
import { droppedFrames, parseLiveMessage, qualityText } from "../src/live/message";
import { lateBy } from "../src/live/picture";
import { BitMeter, RateMeter } from "../src/live/rate";
import { backoff, LONGEST_SILENCE_MS, ReconnectingSocket } from "../src/live/socket";
import { leadingPasses, OTHERS, stacked, timeOf, type Sample } from "../src/live/telemetry";
import { awaitedChange } from "../src/state/liveState";

function message(header: object, jpeg: readonly number[]): ArrayBuffer {
  const text = new TextEncoder().encode(JSON.stringify(header));
  const bytes = new Uint8Array(4 + text.length + jpeg.length);
  new DataView(bytes.buffer).setUint32(0, text.length, true);
  bytes.set(text, 4);
  bytes.set(jpeg, 4 + text.length);
  return bytes.buffer;
}

function sample(at: number, passes: Record<string, number>): Sample {
  return { at, rate: 30, took: 20, passes, reused: new Set() };
}

describe("a message of the live picture", () => {
  it("comes apart into header and picture", () => {
    const { header, coded } = parseLiveMessage(message({ frame_id: 7, renderer: "é" }, [255, 216, 255]));
    expect(header.frame_id).toBe(7);
    expect(header.renderer).toBe("é");
    expect([...coded]).toEqual([255, 216, 255]);
  });

  it("takes from the one before what its header leaves out, unless it is a key", () => {
    const { header } = parseLiveMessage(message({ frame_id: 7, codec: "avc1.64001e", keyframe: true }, []));
    const next = parseLiveMessage(message({ frame_id: 8, keyframe: false }, []), header).header;
    expect(next).toEqual({ frame_id: 8, codec: "avc1.64001e", keyframe: false });
    expect(parseLiveMessage(message({ frame_id: 9 }, []), next).header.codec).toBe("avc1.64001e");
    const key = { frame_id: 10, codec: "jpeg", keyframe: true };
    expect(parseLiveMessage(message(key, []), next).header).toEqual(key);
  });

  it("is refused where it is cut short", () => {
    expect(() => parseLiveMessage(message({ frame_id: 7 }, []).slice(0, 8))).toThrow();
    expect(() => parseLiveMessage(new ArrayBuffer(2))).toThrow();
  });

  it("counts a lost frame once, though depth and pose went with it", () => {
    expect(droppedFrames({ "color.camera": 3, "clean_depth.camera": 3, "pose.camera": 2 })).toBe(3);
  });
});

describe("the quality of a picture", () => {
  it("is named with the share of its size that was rendered", () => {
    expect(qualityText({ quality: "best", scale: 1 })).toBe("best");
    expect(qualityText({ quality: "live", scale: 0.75 })).toBe("live, 75 %");
    expect(qualityText({ quality: null, scale: 1 })).toBe("–");
  });
});

describe("the connection", () => {
  it("waits longer after each failure, up to ten seconds", () => {
    expect([0, 1, 2, 3, 10].map(backoff)).toEqual([500, 1000, 2000, 4000, 10_000]);
  });

  it("is made anew when nothing was heard for a minute", async () => {
    const made: { onopen?: () => void; onmessage?: (event: object) => void; close: () => void }[] = [];
    const close = vi.fn();
    vi.useFakeTimers();
    vi.stubGlobal("document", { baseURI: "http://127.0.0.1/" });
    vi.stubGlobal(
      "WebSocket",
      class {
        close = close;
        constructor() {
          made.push(this);
        }
      },
    );
    const socket = new ReconnectingSocket("/live", () => undefined);
    socket.start();
    await vi.advanceTimersByTimeAsync(0);
    made[0]!.onopen!();
    await vi.advanceTimersByTimeAsync(LONGEST_SILENCE_MS - 1);
    made[0]!.onmessage!({});
    await vi.advanceTimersByTimeAsync(LONGEST_SILENCE_MS - 1);
    expect(made.length).toBe(1);
    await vi.advanceTimersByTimeAsync(1);
    expect(made.length).toBe(2);
    expect(close).toHaveBeenCalledOnce();
    made[1]!.onopen!();
    expect(socket.state.value).toBe("open");
    socket.stop();
    vi.useRealTimers();
    vi.unstubAllGlobals();
  });
});

describe("the plots", () => {
  const all = [sample(0, { a: 1, b: 5, c: 2, d: 1 }), sample(1, { a: 1, b: 4, c: 3 })];

  it("name the costliest passes and gather the rest", () => {
    expect(leadingPasses(all, 2)).toEqual(["b", "c", OTHERS]);
    expect(leadingPasses(all, 4)).toEqual(["b", "c", "a", "d"]);
    expect(leadingPasses([...all, sample(2, { d: 1 })], 2)).toEqual(["d", "b", OTHERS]);
    expect(timeOf(all[0]!, OTHERS, ["b", "c", OTHERS])).toBe(2);
  });

  it("stack to the sum of all passes", () => {
    expect(stacked(all, ["b", "c", OTHERS])).toEqual([
      [5, 4],
      [7, 7],
      [9, 8],
    ]);
  });
});

describe("the rate", () => {
  it("counts pictures up to now, those that this browser skipped too", () => {
    const meter = new RateMeter();
    expect(meter.rate(0)).toBeNull();
    meter.note(1, 0);
    expect(meter.rate(500)).toBeNull();
    meter.note(2, 5);
    expect(meter.rate(5)).toBeNull(); // it had waited
    meter.note(3, 1000);
    expect(meter.rate(1000)).toBeCloseTo(2, 9);
    expect(meter.rate(4000)).toBeCloseTo(0.5, 9); // nothing came since
  });

  it("forgets what is longer ago than three seconds, and a service that began anew", () => {
    const meter = new RateMeter();
    for (let number = 1; number <= 11; number++) meter.note(number, 1000 * number);
    expect(meter.rate(11_000)).toBeCloseTo(1, 9);
    meter.note(1, 12_000);
    expect(meter.rate(12_500)).toBeNull();
  });
});

describe("the bit rate", () => {
  it("is that of the last three seconds, up to now", () => {
    const meter = new BitMeter();
    for (let second = 0; second <= 10; second++) meter.note(1000, 1000 * second);
    expect(meter.kilobits(10_000)).toBeCloseTo(8, 9);
    expect(meter.kilobits(12_000)).toBeCloseTo(4, 9); // nothing came since
    expect(new BitMeter().kilobits(0)).toBeNull();
  });
});

describe("the delay", () => {
  const shown = (at: number, delay: number) => ({ at, delay });

  it("is the median and the 95th percentile of the last ten seconds", () => {
    expect(delayFigures([])).toBeNull();
    expect(delayFigures([shown(5, 80)])).toEqual({ median: 80, p95: 80 });
    const hundred = Array.from({ length: 100 }, (_, index) => shown(20 + index / 100, ((index * 37) % 100) + 1));
    expect(delayFigures([shown(1, 5000), ...hundred])).toEqual({ median: 50, p95: 95 });
  });

  it("is told in one way everywhere", () => {
    expect(delayText({ median: 181.4, p95: 1240 })).toBe("181 ms (p95 1.24 s)");
    expect(delayText(null)).toBe("–");
  });
});

describe("a late frame", () => {
  it("is later than three of the slowest frames, and than a second and a half", () => {
    expect(lateBy(1400, 20)).toBe(0);
    expect(lateBy(1600, 20)).toBe(1600);
    expect(lateBy(5000, 2000)).toBe(0);
    expect(lateBy(7000, 2000)).toBe(7000);
    expect(lateBy(11_000, 60_000)).toBe(11_000);
  });
});

describe("a change that is rendered", () => {
  const at = (revision: number, id = "a") => ({ id, revision });

  it("is waited for since the oldest one that the picture lacks", () => {
    const first = awaitedChange(null, at(1), at(2), 100);
    expect(first).toEqual({ revision: 2, sinceMs: 100 });
    expect(awaitedChange(first, at(1), at(5), 200)).toEqual(first);
    expect(awaitedChange(first, at(2), at(5), 300)).toEqual({ revision: 5, sinceMs: 300 });
    expect(awaitedChange(first, at(5), at(5), 400)).toBeNull();
  });

  it("may be another scene, and is nothing where another program set the scene", () => {
    expect(awaitedChange(null, at(9, "b"), at(2), 100)).toEqual({ revision: 2, sinceMs: 100 });
    expect(awaitedChange(null, null, at(2), 100)).toBeNull();
    expect(awaitedChange(null, at(2), null, 100)).toBeNull();
  });
});
