import { useEffect } from "preact/hooks";
import { processes, readFisheye } from "../../state/processes";
import { Empty } from "../ui/Empty";
import { FisheyePicture } from "./FisheyePicture";
import { ProcessCard } from "./ProcessCard";

const FISHEYE_INTERVAL_MS = 2000;

/** What runs, how it is doing, and what the fish-eye camera sees. */
export function NodesPanel() {
  useEffect(() => {
    void readFisheye();
    const timer = setInterval(() => void readFisheye(), FISHEYE_INTERVAL_MS);
    return () => clearInterval(timer);
  }, []);
  const known = [...processes.value.values()];
  return (
    <div class="cards">
      {known.length === 0 && (
        <Empty icon="node" title="Nothing reports">
          <p>
            Start a camera node and the render server: <code>deltalight up --source CAMERA</code>
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
