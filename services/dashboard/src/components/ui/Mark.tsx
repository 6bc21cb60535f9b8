/** The sign of the project: a delta with its light. */
export function Mark() {
  return (
    <svg class="mark" viewBox="0 0 32 32" aria-hidden="true" focusable="false">
      <path d="M16 3 30 28H2Z" fill="none" stroke="currentColor" stroke-width="2.6" stroke-linejoin="round" />
      <path d="M16 12.500 24.500 28h-17Z" fill="var(--accent)" />
    </svg>
  );
}
