import { frame, liveState } from "../../live/picture";
import { replay } from "../../state/takes";

const WORDS = {
  connecting: "Connecting",
  reconnecting: "Reconnecting",
  waiting: "Waiting for a picture",
  stale: "Stale",
  "no-board": "No board in view",
  live: "Live",
} as const;

/** How the picture is doing, in a word, with its rate. */
export function LiveState() {
  const state = liveState.value;
  const rate = frame.value?.frames_per_s;
  const word = state === "live" && replay.value?.recording ? "Replay" : WORDS[state];
  return (
    <span class={`live-state ${state}`}>
      <i aria-hidden="true" />
      <span role="status">{word}</span>
      {state === "live" && typeof rate === "number" && <span class="quiet">{rate.toFixed(1)} fps</span>}
    </span>
  );
}
