import type { ComponentChildren } from "preact";

interface TreeGroupProps {
  readonly title: string;
  readonly action?: ComponentChildren;
  /** Said where there is nothing to list; null where there is. */
  readonly empty?: string | null;
  readonly children: ComponentChildren;
}

/** A titled tree of items. */
export function TreeGroup({ title, action, empty = null, children }: TreeGroupProps) {
  return (
    <section class="tree-group" aria-label={title}>
      <header class="spread">
        <h2>{title}</h2>
        {action}
      </header>
      {empty === null ? (
        <div role="tree" aria-label={title}>
          {children}
        </div>
      ) : (
        <p class="tree-empty">{empty}</p>
      )}
    </section>
  );
}
