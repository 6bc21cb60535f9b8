// One message of the live picture: uint32 little-endian length of a JSON header, the header, a JPEG.
import type { CameraDict, Matrix4 } from "../math/camera";

export interface FrameHeader {
  readonly number: number;
  readonly frame_id: number;
  readonly capture_ns: number;
  readonly age_ms: number | null;
  readonly frames_per_s: number | null;
  /** Composites that this connection did not send because the newest goes first. */
  readonly skipped: number;
  readonly status: "ok" | "no_pose";
  readonly drops: Readonly<Record<string, number>>;
  readonly pass_times_ms: Readonly<Record<string, number>>;
  readonly lights: readonly Readonly<Record<string, unknown>>[];
  readonly camera: CameraDict | null;
  readonly world_from_camera: Matrix4 | null;
  readonly scene: { readonly id: string; readonly revision: number } | null;
  readonly renderer: string;
}

export interface LiveMessage {
  readonly header: FrameHeader;
  readonly jpeg: Uint8Array<ArrayBuffer>;
}

const LENGTH_BYTES = 4;

/** Take a message apart; throws a RangeError or SyntaxError for what is none. */
export function parseLiveMessage(data: ArrayBuffer): LiveMessage {
  const headerLength = new DataView(data).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(data, LENGTH_BYTES, headerLength));
  return {
    header: JSON.parse(text) as FrameHeader,
    jpeg: new Uint8Array(data, LENGTH_BYTES + headerLength),
  };
}

/** Frames that were lost on their way; depth and pose go with their colour frame and are not counted again. */
export function droppedFrames(drops: FrameHeader["drops"]): number {
  return Object.entries(drops)
    .filter(([cause]) => !/^(clean_depth|pose)\./.test(cause))
    .reduce((sum, [, count]) => sum + count, 0);
}
