import { API } from "../../api/http";
import { role } from "../../api/session";
import type { Recording } from "../../api/types";
import { bytes, clock, counted } from "../../math/units";
import {
  deleteRecording,
  isGrowing,
  makeVideo,
  replay,
  showRecording,
  stopRecording,
  stopVideo,
  videos,
} from "../../state/takes";
import { Button } from "../ui/Button";
import { download } from "../ui/download";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";
import { SecureImage } from "../ui/SecureImage";
import { Sentence } from "../ui/Sentence";

export function RecordingCard({ recording }: { readonly recording: Recording }) {
  const mayChange = role.value === "control";
  const path = `${API}/recordings/${recording.id}`;
  const isRunning = isGrowing(recording);
  const isShown = replay.value?.recording === recording.id;
  const entries: MenuEntry[] = [
    { label: "Download .mcap", icon: "download", onClick: () => download(`${path}/content`, `${recording.id}.mcap`) },
    {
      label: "Download .mp4",
      icon: "film",
      disabled: recording.composites === 0 || videos.value.has(recording.id),
      onClick: () => downloadVideo(path, recording.id),
    },
    { label: "Delete", icon: "trash", disabled: !mayChange || isShown, onClick: () => deleteRecording(recording.id) },
  ];
  return (
    <article class={`card take ${isShown ? "current" : ""}`} aria-label={recording.id}>
      {isRunning ? (
        <div class="poster running">{recording.state === "waiting" ? "Waiting for the next frame" : "Recording"}</div>
      ) : (
        <SecureImage className="poster" path={`${path}/poster.jpg`} alt="" />
      )}
      <div class="take-text">
        <h3 class="cut">{recording.id}</h3>
        <p class="quiet small">
          <Sentence text={recording.detail || factsText(recording)} />
        </p>
        <Checklist recording={recording} />
        <VideoProgress id={recording.id} />
        <div class="row">
          {isRunning ? (
            <Button icon="stop" disabled={!mayChange} onClick={() => stopRecording(recording.id)}>
              Stop
            </Button>
          ) : (
            <Button
              icon="play"
              disabled={!mayChange || recording.state !== "finished"}
              onClick={() => showRecording(recording.id)}
            >
              Replay
            </Button>
          )}
          {!isRunning && (
            <Menu label={`Actions for ${recording.id}`} entries={entries} kind="icon-only plain">
              <Icon name="more" />
            </Menu>
          )}
        </div>
      </div>
    </article>
  );
}

async function downloadVideo(path: string, id: string): Promise<void> {
  if (await makeVideo(id)) await download(`${path}/video.mp4`, `${id}.mp4`);
}

/** How far the video of a recording is that is being made. */
function VideoProgress({ id }: { readonly id: string }) {
  const share = videos.value.get(id);
  if (share === undefined) return null;
  return (
    <div class="row small">
      <label class="upload">
        <span>Making the video</span>
        <progress value={share} />
      </label>
      <Button icon="stop" onClick={() => stopVideo(id)}>
        Cancel
      </Button>
    </div>
  );
}

/** What relighting needs of a recording, and what to do without. */
function Checklist({ recording }: { readonly recording: Recording }) {
  if (recording.checklist.length === 0) return null;
  return (
    <ul class="checklist small" aria-label="What relighting needs">
      {recording.checklist.map(({ what, is_there, text }) => (
        <li key={what} class={is_there ? "there" : "missing"}>
          <Icon name={is_there ? "check" : "alert"} />
          {text}
        </li>
      ))}
    </ul>
  );
}

function factsText({ duration_s, frames, composites, size_bytes, changed }: Recording): string {
  const day = new Date(changed).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  const facts = [
    duration_s === null ? "" : clock(duration_s),
    frames === null ? "" : counted(frames, "frame"),
    composites === 0 ? "" : counted(composites, "relit picture"),
    bytes(size_bytes),
    day,
  ];
  return facts.filter(Boolean).join(", ");
}
