import { useEffect, useRef } from "preact/hooks";
import { Gesture } from "../../state/gesture";
import type { Patch, Target } from "../../state/targets";

// Changes that follow each other faster than this are one for undo.
const PAUSE_MS = 1000;

interface Handle {
  readonly push: (patch: Patch) => void;
  readonly end: () => void;
}

/** Changes of a control's target: a drag or a run of key presses is undone as one. */
export function useGesture(target: Target): Handle {
  const current = useRef<Gesture | null>(null);
  const timer = useRef<ReturnType<typeof setTimeout> | undefined>(undefined);
  const end = (): void => {
    clearTimeout(timer.current);
    current.current = null;
  };
  useEffect(() => end, [target.path]);
  const push = (patch: Patch): void => {
    clearTimeout(timer.current);
    current.current ??= new Gesture(target);
    current.current.push(patch);
    timer.current = setTimeout(end, PAUSE_MS);
  };
  return { push, end };
}
