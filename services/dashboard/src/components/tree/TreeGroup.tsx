import type { ComponentChildren } from "preact";

interface TreeGroupProps {
  readonly title: string;
  readonly action?: ComponentChildren;
  readonly children: ComponentChildren;
}

export function TreeGroup({ title, action, children }: TreeGroupProps) {
  return (
    <section class="tree-group" role="group" aria-label={title}>
      <header class="spread">
        <h2>{title}</h2>
        {action}
      </header>
      {children}
    </section>
  );
}
