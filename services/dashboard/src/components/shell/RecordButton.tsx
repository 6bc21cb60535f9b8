import { useEffect } from "preact/hooks";
import { useSignal } from "@preact/signals";
import { role } from "../../api/session";
import { clock } from "../../math/units";
import { openDrawer } from "../../state/preferences";
import { running, startRecording, stopRecording } from "../../state/takes";

/** Starts and stops a recording; counts while it runs. */
export function RecordButton() {
  const current = running.value;
  const now = useSignal(Date.now());
  useEffect(() => {
    if (!current) return;
    const timer = setInterval(() => (now.value = Date.now()), 250);
    return () => clearInterval(timer);
  }, [current?.id]);
  const toggle = (): void => {
    openDrawer("recordings");
    void (current ? stopRecording(current.id) : startRecording());
  };
  const seconds = current ? (now.value - Date.parse(current.changed)) / 1000 : 0;
  return (
    <button
      type="button"
      class={`button plain ${current ? "recording" : ""}`}
      aria-label={current ? "Stop recording" : "Record"}
      aria-pressed={current !== null}
      disabled={role.value !== "control"}
      onClick={toggle}
    >
      <span class="dot" />
      {current ? clock(seconds) : <span class="wide-label">Record</span>}
    </button>
  );
}
