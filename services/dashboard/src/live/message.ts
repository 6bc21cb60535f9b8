// One message of the live picture: uint32 little-endian length of a JSON header, the header, a coded picture.
import type { LiveHeader } from "../api/types";

export interface LiveMessage {
  readonly header: LiveHeader;
  /** A JPEG or an access unit of H.264, as the header says; empty where the picture is the one before. */
  readonly coded: Uint8Array<ArrayBuffer>;
}

const LENGTH_BYTES = 4;

/** Take a message apart, `before` the header of the one before it; throws a RangeError or SyntaxError for what is none. */
export function parseLiveMessage(data: ArrayBuffer, before: LiveHeader | null = null): LiveMessage {
  const headerLength = new DataView(data).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(data, LENGTH_BYTES, headerLength));
  const said = JSON.parse(text) as Partial<LiveHeader>;
  const isWhole = said.keyframe ?? before?.keyframe ?? true;
  return {
    header: (isWhole ? said : { ...before, ...said }) as LiveHeader,
    coded: new Uint8Array(data, LENGTH_BYTES + headerLength),
  };
}

/** The quality that a picture was rendered in; with the scale where it was rendered smaller and enlarged: "live, 50 %". */
export function qualityText({ quality, scale }: Pick<LiveHeader, "quality" | "scale">): string {
  if (quality === null) return "–";
  return scale < 1 ? `${quality}, ${Math.round(100 * scale)} %` : quality;
}

/** Frames that were lost on their way; depth and pose go with their colour frame and are not counted again. */
export function droppedFrames(drops: LiveHeader["drops"]): number {
  return Object.entries(drops)
    .filter(([cause]) => !/^(clean_depth|pose)\./.test(cause))
    .reduce((sum, [, count]) => sum + count, 0);
}
