import type { ComponentChildren } from "preact";

interface SectionProps {
  readonly title: string;
  readonly action?: ComponentChildren;
  readonly children: ComponentChildren;
}

/** A part of the inspector. */
export function Section({ title, action, children }: SectionProps) {
  return (
    <section class="section" aria-label={title}>
      <header class="spread">
        <h2>{title}</h2>
        {action}
      </header>
      {children}
    </section>
  );
}
