// Numbers as people read them.
const UNITS: readonly (readonly [suffix: string, unit: string])[] = [
  ["_m", "m"],
  ["_deg", "°"],
  ["_s", "s"],
  ["_ms", "ms"],
  ["_mb", "MB"],
  ["_px", "px"],
];
const BYTE_UNITS = ["B", "kB", "MB", "GB"];

/** The unit that a key's ending names; empty without. */
export function unitOf(key: string): string {
  return UNITS.find(([suffix]) => key.endsWith(suffix))?.[1] ?? "";
}

/** A key in words: `volume_edge_m` is "Volume edge". */
export function labelOf(key: string): string {
  const suffix = UNITS.find(([ending]) => key.endsWith(ending))?.[0] ?? "";
  const words = key.slice(0, key.length - suffix.length).replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** At most `decimals` digits behind the point, without trailing zeros. */
export function trimmed(value: number, decimals = 4): string {
  const text = value.toFixed(decimals);
  const short = text.includes(".") ? text.replace(/\.?0+$/, "") : text;
  return short === "-0" ? "0" : short;
}

/** A count with its noun, whose plural is formed with an s: "1 frame", "1,200 frames". */
export function counted(count: number, noun: string): string {
  return `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;
}

export function bytes(count: number): string {
  let value = count;
  let index = 0;
  while (value >= 1000 && index < BYTE_UNITS.length - 1) {
    value /= 1000;
    index += 1;
  }
  return `${trimmed(value, value < 10 && index > 0 ? 1 : 0)} ${BYTE_UNITS[index] ?? ""}`;
}

/** Minutes and seconds: 75.4 is "1:15". */
export function clock(seconds: number): string {
  const whole = Math.max(0, Math.floor(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

export function milliseconds(value: number): string {
  return value >= 1000 ? `${trimmed(value / 1000, 2)} s` : `${trimmed(value, value < 10 ? 1 : 0)} ms`;
}

/** Pictures a second; slow ones with a digit more. */
export function rateText(perSecond: number | null): string {
  return perSecond === null ? "–" : `${perSecond.toFixed(perSecond < 1 ? 2 : 1)} fps`;
}

/** Of a stream; a thousand and more in millions. */
export function bitrateText(kilobits: number | null): string {
  if (kilobits === null) return "–";
  return kilobits >= 1000 ? `${(kilobits / 1000).toFixed(1)} Mbit/s` : `${kilobits.toFixed(0)} kbit/s`;
}

export function size(metres: number): string {
  return sizesText([metres]);
}

/** Lengths in the unit that suits the longest: "14.5 × 7.6 cm". */
export function sizesText(metres: readonly number[]): string {
  const longest = Math.max(...metres);
  const [unit, factor, decimals] =
    longest < 0.1
      ? (["mm", 1000, longest < 0.01 ? 1 : 0] as const)
      : longest < 1
        ? (["cm", 100, 1] as const)
        : (["m", 1, 2] as const);
  return `${metres.map((each) => trimmed(each * factor, decimals)).join(" × ")} ${unit}`;
}
