import { useEffect } from "preact/hooks";
import { useSignal } from "@preact/signals";
import { withTicket } from "../../api/tickets";

interface SecureImageProps {
  readonly path: string;
  readonly alt: string;
  readonly className?: string;
}

/** A picture of the service; its address carries a ticket where a token is needed. */
export function SecureImage({ path, alt, className = "" }: SecureImageProps) {
  const address = useSignal<string | null>(null);
  const isMissing = useSignal(false);
  useEffect(() => {
    let isCurrent = true;
    isMissing.value = false;
    withTicket(path).then(
      (found) => isCurrent && (address.value = found),
      () => isCurrent && (isMissing.value = true),
    );
    return () => void (isCurrent = false);
  }, [path]);
  if (isMissing.value) return <span class={`no-image ${className}`} role="img" aria-label={alt} />;
  return (
    <img
      class={className}
      src={address.value ?? undefined}
      alt={alt}
      loading="lazy"
      draggable={false}
      onError={() => (isMissing.value = address.value !== null)}
    />
  );
}
