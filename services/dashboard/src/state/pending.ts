// Changes on their way; what depends on the scene as a whole waits for them.
const pending = new Set<Promise<unknown>>();

export function track<T>(work: Promise<T>): Promise<T> {
  pending.add(work);
  void work.finally(() => pending.delete(work));
  return work;
}

/** When every change that was begun has been answered. */
export async function settled(): Promise<void> {
  while (pending.size > 0) await Promise.allSettled(pending);
}
