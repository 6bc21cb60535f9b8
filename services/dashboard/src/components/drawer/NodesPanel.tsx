import { useEffect } from "preact/hooks";
import { hasFisheye, isSilent, processes, readFisheye, REPLAY, type Seen } from "../../state/processes";
import { replay } from "../../state/takes";
import { Empty } from "../ui/Empty";
import { Skeleton } from "../ui/Skeleton";
import { FisheyePicture } from "./FisheyePicture";
import { ProcessCard } from "./ProcessCard";

const INTERVAL_MS = 2000;

/** What runs, how it is doing, and what the fish-eye camera sees. */
export function NodesPanel() {
  useEffect(() => {
    void readFisheye();
    const timer = setInterval(() => void readFisheye(), INTERVAL_MS);
    return () => clearInterval(timer);
  }, []);
  if (hasFisheye.value === null) return <Skeleton lines={4} />;
  const known = [...processes.value.values()].filter((seen) => !isEndedReplay(seen));
  return (
    <div class="cards">
      {known.length === 0 && (
        <Empty icon="node" title="Nothing is running">
          <p>
            Start a camera and the render server: <code>deltalight up --source CAMERA</code>
          </p>
        </Empty>
      )}
      {known.map((seen) => (
        <ProcessCard key={seen.report.name} seen={seen} />
      ))}
      <FisheyePicture />
    </div>
  );
}

/** A replay that is over is no process that fell silent. */
function isEndedReplay(seen: Seen): boolean {
  return seen.report.name === REPLAY && isSilent(seen) && replay.value?.recording == null;
}
