import { useEffect } from "preact/hooks";
import { hasFisheye, processes, readFisheye } from "../../state/processes";
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
  const known = [...processes.value.values()];
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
