import { useEffect } from "preact/hooks";
import { role } from "../../api/session";
import type { Replay } from "../../api/types";
import { clock } from "../../math/units";
import {
  backToLive,
  changeReplay,
  isMovable,
  play,
  readReplay,
  replay,
  scrub,
  showRecording,
  step,
} from "../../state/takes";
import { Button } from "../ui/Button";
import { IconButton } from "../ui/IconButton";
import { Select } from "../ui/Select";

const RATES = ["0.25", "0.5", "1", "2", "4"].map((value) => ({ value, label: `${value}×` }));
const POLL_MS = 1000;
// Of such a recording tenths of seconds are told.
const SHORT_S = 10;

/** Timeline of the recording that is shown: in place of the camera, or where the node itself plays one. */
export function ReplayBar() {
  const shown = replay.value;
  const isShown = isMovable.value;
  useEffect(() => {
    if (!isShown) return;
    const timer = setInterval(() => void readReplay(), POLL_MS);
    return () => clearInterval(timer);
  }, [isShown]);
  if (!shown || !isShown) return null;
  const disabled = role.value !== "control";
  const isSource = shown.recording === null;
  return (
    <div class="replay" role="group" aria-label={isSource ? "Camera motion" : "Replay"}>
      <IconButton
        icon={shown.playing ? "pause" : "play"}
        label={shown.playing ? "Pause" : "Play"}
        disabled={disabled}
        onClick={() => play(!shown.playing)}
      />
      <span class="cut replay-name">{shown.recording ?? "Camera motion"}</span>
      <Timeline shown={shown} disabled={disabled} />
      {!isSource && (
        <IconButton
          icon="loop"
          label="Loop"
          pressed={shown.loop === true}
          disabled={disabled}
          onClick={() => setLoop(!shown.loop)}
        />
      )}
      <Select
        label="Speed"
        value={String(shown.rate ?? 1)}
        choices={RATES}
        onChange={(rate) => changeReplay({ rate: Number(rate) })}
        disabled={disabled}
      />
      {!isSource && (
        <Button kind="primary" disabled={disabled} onClick={backToLive}>
          Back to live
        </Button>
      )}
    </div>
  );
}

async function setLoop(loop: boolean): Promise<void> {
  await readReplay();
  const recording = replay.value?.recording;
  if (recording) await showRecording(recording, { ...replay.value, loop });
}

/** Arrow keys go from frame to frame. */
function stepFrame(event: KeyboardEvent): void {
  const frames = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
  if (!frames) return;
  event.preventDefault();
  step(frames);
}

function Timeline({ shown, disabled }: { readonly shown: Replay; readonly disabled: boolean }) {
  const position = shown.position_s ?? 0;
  const duration = shown.duration_s ?? 0;
  const share = duration > 0 ? position / duration : 0;
  const text = duration < SHORT_S ? (seconds: number) => `${seconds.toFixed(1)} s` : clock;
  return (
    <>
      <span class="quiet">{text(position)}</span>
      <input
        type="range"
        class="grow"
        aria-label="Position"
        aria-valuetext={`${text(position)} of ${text(duration)}`}
        min={0}
        max={duration}
        step="any"
        value={position}
        disabled={disabled}
        onKeyDown={stepFrame}
        onInput={(event) => scrub(event.currentTarget.valueAsNumber)}
        ref={(element) => element?.style.setProperty("--filled", `${100 * share}%`)}
      />
      <span class="quiet">{text(duration)}</span>
    </>
  );
}
