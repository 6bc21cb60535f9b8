import { lateMs, retryPicture } from "../../live/picture";
import { changeMs, isSending, liveState } from "../../state/liveState";
import { hasPoster } from "../../state/begin";
import { hasFisheye, processes, renderServer, renderServerName } from "../../state/processes";
import { isSceneRead, lights, scene } from "../../state/scene";
import { isTakingSnapshot } from "../../state/takes";
import { Button } from "../ui/Button";
import { Icon } from "../ui/Icon";
import { Sentence } from "../ui/Sentence";
import { useStateWatch } from "../ui/useStateWatch";

/** Says why there is no picture, or why it stands still, and what to do. */
export function PictureNotice() {
  switch (liveState.value) {
    case "connecting":
      if (hasPoster.value) return <Working text={STILL} />;
      return <Full title="Connecting to the live picture" text="Asking the server for the newest frame." />;
    case "waiting":
      if (hasPoster.value)
        return isWorking() ? <Working text={STILL + waitingText()} /> : <Banner text={waitingText()} />;
      return <Full title="No picture yet" text={waitingText()} />;
    case "reconnecting":
      return (
        <p class="picture-banner">
          <Icon name="alert" /> Connection lost. This is the last picture.
          <Button kind="plain" onClick={retryPicture}>
            Try now
          </Button>
        </p>
      );
    case "stale":
      return <Banner text={renderServer.value === "silent" ? SILENT : STOPPED} />;
    case "rendering":
      return <Working text={workText()} />;
    case "no-board":
      return (
        <Banner text="The marker board is not in view, so objects cannot be placed. Point the camera at the board." />
      );
    case "live":
      return <SceneNotice />;
  }
}

const STILL = "This is a still; the live picture follows. ";
const NOTHING_SENDS =
  "Neither a camera nor a recording is sending frames. Start one with `deltalight up --source CAMERA`, or replay a recording below.";
const PREPARING =
  "Frames are arriving, and the renderer is preparing its first picture. The first start on a machine can take a minute while the shaders compile.";
const SILENT = "The render server does not respond. Your changes are kept, and will appear as soon as it does.";
const STOPPED = "The camera sends no new frames. Nodes, below, shows what has stopped.";
const NO_FISHEYE =
  "This scene is lit by a fish-eye camera, and none is sending. Objects appear once one does. Or choose another light source under Lights.";

/** Whether a picture will come by itself. */
function isWorking(): boolean {
  return renderServer.value === null || isSending();
}

function waitingText(): string {
  if (renderServer.value === null) return "Asking the server what is running.";
  if (!isSending()) return NOTHING_SENDS;
  const { state, detail } = processes.value.get(renderServerName.value)?.report ?? {};
  return state === "starting" && detail ? detail : PREPARING;
}

function workText(): string {
  const seconds = (ms: number): string => `${Math.round(ms / 1000)} s`;
  if (isTakingSnapshot.value) return "Taking the snapshot. The live picture continues afterwards.";
  if (changeMs.value > 0) return `Rendering your change… ${seconds(changeMs.value)}`;
  return `Waiting for the next frame… ${seconds(lateMs.value)}`;
}

/** What the scene lacks to be seen. */
function SceneNotice() {
  const needsFisheye = lights.value?.mode === "fisheye";
  useStateWatch(needsFisheye);
  if (isSceneRead.value && scene.value === null)
    return <Banner text="No scene is open. Add an object, or choose a scene under Scenes." />;
  const state = scene.value?.picture;
  if (state?.state === "refused") return <Banner text={state.detail} />;
  if (state?.state === "pending" && renderServer.value === "silent") return <Banner text={SILENT} />;
  return needsFisheye && hasFisheye.value === false ? <Banner text={NO_FISHEYE} /> : null;
}

function Working({ text }: { readonly text: string }) {
  return (
    <p class="picture-banner working">
      <i aria-hidden="true" /> <Sentence text={text} />
    </p>
  );
}

function Banner({ text }: { readonly text: string }) {
  return (
    <p class="picture-banner">
      <Icon name="alert" /> <Sentence text={text} />
    </p>
  );
}

function Full({ title, text }: { readonly title: string; readonly text: string }) {
  return (
    <div class="picture-full">
      <Icon name="film" />
      <h2>{title}</h2>
      <p>
        <Sentence text={text} />
      </p>
    </div>
  );
}
