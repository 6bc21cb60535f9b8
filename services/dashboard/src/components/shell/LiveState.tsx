import { rate } from "../../live/picture";
import { rateText } from "../../math/units";
import { changeMs, liveState } from "../../state/liveState";
import { replay } from "../../state/takes";

const WORDS = {
  connecting: "Connecting",
  reconnecting: "Reconnecting",
  waiting: "Waiting for the first frame",
  rendering: "Waiting for the next frame",
  stale: "No new frames",
  "no-board": "No board in view",
  live: "Live",
} as const;

/** How the picture is doing, in a word, with its rate. */
export function LiveState() {
  const state = liveState.value;
  return (
    <span class={`live-state ${state}`}>
      <i aria-hidden="true" />
      <span role="status">{word()}</span>
      {state === "live" && rate.value !== null && <span class="quiet live-rate">{rateText(rate.value)}</span>}
    </span>
  );
}

function word(): string {
  const state = liveState.value;
  if (state === "live" && replay.value?.recording) return "Replay";
  return state === "rendering" && changeMs.value > 0 ? "Rendering" : WORDS[state];
}
