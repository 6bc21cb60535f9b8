import type { ComponentChildren } from "preact";
import { useErrorBoundary } from "preact/hooks";
import { Button } from "./Button";

interface BoundaryProps {
  /** What fails, as people call it, such as "The inspector". */
  readonly name: string;
  readonly children: ComponentChildren;
}

/** Keeps a fault in one part of the page from taking the others with it. */
export function Boundary({ name, children }: BoundaryProps) {
  const [fault, retry] = useErrorBoundary((error: unknown) => console.error(error)) as [unknown, () => void];
  if (fault === undefined) return children;
  return (
    <div class="empty" role="alert">
      <h3>{name} failed</h3>
      <p>This is a bug in the page. Your scene is safe, and everything else keeps working.</p>
      <Button onClick={retry}>Try again</Button>
    </div>
  );
}
