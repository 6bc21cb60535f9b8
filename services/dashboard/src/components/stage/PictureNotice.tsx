import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { isSceneRead, scene } from "../../state/scene";
import { frame, liveState, retryPicture } from "../../live/picture";
import { processes } from "../../state/processes";
import { isTakingSnapshot } from "../../state/takes";
import { Button } from "../ui/Button";
import { Sentence } from "../ui/Sentence";
import { Icon } from "../ui/Icon";

/** Says why there is no picture, or why it stands still, and what to do. */
export function PictureNotice() {
  switch (liveState.value) {
    case "connecting":
      return <Full title="Connecting to the live picture" text="The service is asked for the newest frame." />;
    case "waiting":
      return <Full title="No picture yet" text={isSomethingRunning() ? PREPARING : NOTHING_SENDS} />;
    case "reconnecting":
      return (
        <p class="picture-banner">
          <Icon name="alert" /> The connection is lost; this is the last picture.
          <Button kind="plain" onClick={retryPicture}>
            Try now
          </Button>
        </p>
      );
    case "stale":
      return <Banner text={staleText()} />;
    case "no-board":
      return <Banner text="The marker board is not in view, so objects cannot be placed. Point the camera at it." />;
    case "live":
      return isSceneRead.value && scene.value === null ? (
        <Banner text="No scene is shown; add an object, or choose one under Scenes." />
      ) : (
        <Pending />
      );
  }
}

const NOTHING_SENDS =
  "Neither a camera nor a recording sends frames. Start one with `deltalight up --source CAMERA`, or replay a recording below.";
const PREPARING =
  "Frames arrive, and the renderer prepares its first picture. The first start on a machine can take a minute: its shaders are compiled.";

function isSomethingRunning(): boolean {
  return [...processes.value.values()].some((seen) => seen.report.state === "running");
}

// A slow renderer takes a change that late; while it takes others, nothing is wrong.
const TAKEN_MS = 5000;
const PENDING = "The render server does not answer; it gets this scene as soon as it does.";

function staleText(): string {
  if (isTakingSnapshot.value) return "The renderer takes the snapshot; the live picture goes on after it.";
  if (scene.value?.picture?.state === "pending") return PENDING;
  return "No new picture comes. See Nodes below for what stands still.";
}

function Pending() {
  const state = scene.value?.picture;
  const isPending = state?.state === "pending";
  const isLong = useSignal(false);
  useEffect(() => {
    isLong.value = false;
    const timer = setTimeout(() => (isLong.value = true), TAKEN_MS);
    return () => clearTimeout(timer);
  }, [isPending, frame.value?.scene?.revision]);
  if (isPending) return isLong.value ? <Banner text={PENDING} /> : null;
  if (state?.state === "refused") return <Banner text={state.detail} />;
  return null;
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
