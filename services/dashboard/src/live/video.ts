// The live picture as H.264, decoded by the browser (WebCodecs) where it can.
import { signal } from "@preact/signals";
import type { LiveHeader } from "../api/types";

/** Why pictures come as JPEG; null while they come as H.264. */
export const noVideo = signal<string | null>("The page has not requested H.264 yet.");

// High profile at level 4.0: up to 2048 x 1024 pixels. The service names what it really sends.
const USUAL_CODEC = "avc1.640028";
const STUCK_MS = 3000;

/** Whether this browser decodes a kind of H.264; else why not. */
export async function videoProblem(codec = USUAL_CODEC): Promise<string | null> {
  if (typeof VideoDecoder === "undefined")
    return isSecureContext ? "This browser has no WebCodecs." : "Browsers decode video only on https or localhost.";
  const { supported } = await VideoDecoder.isConfigSupported(configOf(codec));
  return supported ? null : "This browser does not decode H.264.";
}

function configOf(codec: string): VideoDecoderConfig {
  return { codec, optimizeForLatency: true };
}

interface Waiting {
  readonly header: LiveHeader;
  readonly arrival: number;
}

/** Decodes the pictures of one connection, in order; `onDone` is called once for each, shown or not. */
export class VideoPictures {
  private decoder: VideoDecoder | null = null;
  private configured = "";
  private count = 0;
  private readonly waiting = new Map<number, Waiting>();

  constructor(
    private readonly show: (picture: VideoFrame, header: LiveHeader, arrival: number) => void,
    private readonly onDone: () => void,
    private readonly onFailure: (reason: string) => void,
  ) {}

  get isIdle(): boolean {
    return this.waiting.size === 0;
  }

  decode(header: LiveHeader, data: Uint8Array<ArrayBuffer>, arrival: number): void {
    const timestamp = this.count++;
    this.waiting.set(timestamp, { header, arrival });
    try {
      if (header.keyframe) this.configure(header.codec);
      const type = header.keyframe ? "key" : "delta";
      this.decoder?.decode(new EncodedVideoChunk({ type, timestamp, data }));
    } catch (fault) {
      this.fail(String(fault));
    }
  }

  /** Fail where the decoder keeps pictures back. */
  checkAt(now: number): void {
    const [oldest] = this.waiting.values();
    if (oldest && now - oldest.arrival > STUCK_MS) this.fail("The decoder produces no pictures.");
  }

  /** Forget what was under way. */
  close(): void {
    this.waiting.clear();
    if (this.decoder && this.decoder.state !== "closed") this.decoder.close();
    this.decoder = null;
    this.configured = "";
  }

  private configure(codec: string): void {
    if (this.decoder && this.configured === codec) return;
    this.decoder ??= new VideoDecoder({
      output: (picture) => this.take(picture),
      error: (fault) => this.fail(fault.message),
    });
    this.decoder.configure(configOf(codec));
    this.configured = codec;
  }

  private take(picture: VideoFrame): void {
    const waiting = this.waiting.get(picture.timestamp);
    this.waiting.delete(picture.timestamp);
    if (waiting) {
      this.show(picture, waiting.header, waiting.arrival);
      this.onDone();
    }
    picture.close();
  }

  private fail(reason: string): void {
    const lost = this.waiting.size;
    this.close();
    this.onFailure(reason);
    for (let index = 0; index < lost; index++) this.onDone();
  }
}
