import { useEffect } from "preact/hooks";
import { useSignal } from "@preact/signals";
import { requestBytes } from "../../api/http";

const PERIOD_MS = 1000;

interface LiveThumbnailProps {
  readonly path: string;
  readonly alt: string;
}

/** The newest picture of a room, once a second; nothing until the first. */
export function LiveThumbnail({ path, alt }: LiveThumbnailProps) {
  const address = useSignal<string | null>(null);
  useEffect(() => {
    let timer: ReturnType<typeof setTimeout> | undefined;
    let isCurrent = true;
    const read = async (): Promise<void> => {
      const bytes = await requestBytes(path).catch(() => null);
      if (!isCurrent) return;
      if (bytes !== null) replace(URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" })));
      timer = setTimeout(() => void read(), PERIOD_MS);
    };
    const replace = (next: string | null): void => {
      if (address.value !== null) URL.revokeObjectURL(address.value);
      address.value = next;
    };
    void read();
    return () => {
      isCurrent = false;
      clearTimeout(timer);
      replace(null);
    };
  }, [path]);
  if (address.value === null) return <span class="no-image" role="img" aria-label={alt} />;
  return <img src={address.value} alt={alt} draggable={false} />;
}
