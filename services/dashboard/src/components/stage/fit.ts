import { useComputed, useSignal, type ReadonlySignal } from "@preact/signals";
import type { RefObject } from "preact";
import { useEffect } from "preact/hooks";
import { pictureSize } from "../../live/picture";

export interface Box {
  readonly left: number;
  readonly top: number;
  readonly width: number;
  readonly height: number;
}

/** The largest box of a picture's shape in the middle of an area. */
export function fitInto(areaWidth: number, areaHeight: number, width: number, height: number): Box {
  const factor = Math.min(areaWidth / width, areaHeight / height);
  const [w, h] = [Math.floor(width * factor), Math.floor(height * factor)];
  return { left: Math.floor((areaWidth - w) / 2), top: Math.floor((areaHeight - h) / 2), width: w, height: h };
}

// Until a picture comes: the shape of most cameras.
const USUAL = { width: 4, height: 3 };

/** Where the live picture lies inside an element, CSS pixels; follows the size of both. */
export function usePictureBox(area: RefObject<HTMLElement | null>): ReadonlySignal<Box> {
  const areaSize = useSignal({ width: 0, height: 0 });
  useEffect(() => {
    if (!area.current) return;
    const observer = new ResizeObserver(([entry]) => {
      if (entry) areaSize.value = { width: entry.contentRect.width, height: entry.contentRect.height };
    });
    observer.observe(area.current);
    return () => observer.disconnect();
  }, []);
  return useComputed(() => {
    const { width, height } = pictureSize.value ?? USUAL;
    return fitInto(areaSize.value.width, areaSize.value.height, width, height);
  });
}
