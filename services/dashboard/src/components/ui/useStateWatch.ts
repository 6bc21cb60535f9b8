import { useEffect } from "preact/hooks";
import { readState } from "../../state/processes";

const INTERVAL_MS = 2000;

/** Ask the service again and again how everything is doing, while that is shown. */
export function useStateWatch(isShown = true): void {
  useEffect(() => {
    if (!isShown) return;
    void readState();
    const timer = setInterval(() => void readState(), INTERVAL_MS);
    return () => clearInterval(timer);
  }, [isShown]);
}
