import { recordings } from "../../state/takes";
import { Empty } from "../ui/Empty";
import { RecordingCard } from "./RecordingCard";

export function RecordingsPanel() {
  return (
    <div class="cards">
      {recordings.value.length === 0 && (
        <Empty icon="film" title="No recordings yet">
          <p>Press Record at the top; colour, depth, pose and light are kept, and can be relit anew in replay.</p>
        </Empty>
      )}
      {recordings.value.map((each) => (
        <RecordingCard key={each.id} recording={each} />
      ))}
    </div>
  );
}
