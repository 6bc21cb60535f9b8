import { recordings } from "../../state/takes";
import { isRead } from "../../state/events";
import { Skeleton } from "../ui/Skeleton";
import { Empty } from "../ui/Empty";
import { RecordingCard } from "./RecordingCard";

export function RecordingsPanel() {
  if (!isRead.value) return <Skeleton lines={4} />;
  return (
    <div class="cards">
      {recordings.value.length === 0 && (
        <Empty icon="film" title="No recordings yet">
          <p>Press Record at the top. Colour, depth, pose and light are recorded, so a recording can be relit later.</p>
        </Empty>
      )}
      {recordings.value.map((each) => (
        <RecordingCard key={each.id} recording={each} />
      ))}
    </div>
  );
}
