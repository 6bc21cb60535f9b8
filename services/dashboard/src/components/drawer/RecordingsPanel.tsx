import { useRef } from "preact/hooks";
import { role } from "../../api/session";
import { recordsRelit } from "../../state/preferences";
import { openRecording, recordings } from "../../state/takes";
import { Button } from "../ui/Button";
import { isRead } from "../../state/events";
import { Switch } from "../ui/Switch";
import { Skeleton } from "../ui/Skeleton";
import { Empty } from "../ui/Empty";
import { RecordingCard } from "./RecordingCard";

export function RecordingsPanel() {
  const file = useRef<HTMLInputElement>(null);
  if (!isRead.value) return <Skeleton lines={4} />;
  const onFile = (input: HTMLInputElement): void => {
    const chosen = input.files?.[0];
    input.value = "";
    if (chosen) void openRecording(chosen);
  };
  return (
    <div class="cards">
      <Button icon="upload" disabled={role.value !== "control"} onClick={() => file.current?.click()}>
        Open a recording…
      </Button>
      <input ref={file} type="file" hidden accept=".mcap,.zip" onChange={(event) => onFile(event.currentTarget)} />
      <Switch
        label="Keep relit pictures too"
        checked={recordsRelit.value}
        onChange={(isOn) => (recordsRelit.value = isOn)}
        disabled={role.value !== "control"}
      />
      {recordings.value.length === 0 && (
        <Empty icon="film" title="No recordings yet">
          <p>
            Press Record at the top. Colour, depth, pose and light are recorded, so a recording can be relit later. Or
            drop an .mcap file or a zipped dataset folder on the picture.
          </p>
        </Empty>
      )}
      {recordings.value.map((each) => (
        <RecordingCard key={each.id} recording={each} />
      ))}
    </div>
  );
}
