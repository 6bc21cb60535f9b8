import { role } from "../../api/session";
import { redo, restore, steps, undo, type Step } from "../../state/history";
import { scene } from "../../state/scene";
import { isRead } from "../../state/events";
import { Skeleton } from "../ui/Skeleton";
import { Button } from "../ui/Button";
import { Empty } from "../ui/Empty";

const MOST = 100;

/** Every change of the scene; any of them can be gone back to, and that is a change too. */
export function HistoryPanel() {
  const current = scene.value;
  if (!isRead.value) return <Skeleton lines={4} />;
  if (!current || steps.value.length === 0) {
    return (
      <Empty icon="history" title="No changes yet">
        <p>Every change to the scene is listed here and can be undone.</p>
      </Empty>
    );
  }
  const mayChange = role.value === "control";
  return (
    <div class="history">
      <div class="row">
        <Button icon="undo" disabled={!mayChange || !current.can_undo} onClick={undo}>
          Undo
        </Button>
        <Button icon="redo" disabled={!mayChange || !current.can_redo} onClick={redo}>
          Redo
        </Button>
      </div>
      <ol aria-label="Revisions, newest first">
        {steps.value.slice(0, MOST).map((each) => (
          <Entry
            key={each.entry.revision}
            step={each}
            isCurrent={each.entry.revision === current.revision}
            mayChange={mayChange}
          />
        ))}
      </ol>
    </div>
  );
}

interface EntryProps {
  readonly step: Step;
  readonly isCurrent: boolean;
  readonly mayChange: boolean;
}

function Entry({ step: { entry, count }, isCurrent, mayChange }: EntryProps) {
  const time = new Date(entry.at).toLocaleTimeString([], { timeStyle: "medium" });
  return (
    <li class="revision" aria-current={isCurrent ? "step" : undefined}>
      <span class="number-cell">{entry.revision}</span>
      <span class="grow cut">
        {entry.what}
        {count > 1 && <span class="quiet">, in {count} steps</span>}
      </span>
      <time class="quiet" dateTime={entry.at}>
        {time}
      </time>
      {isCurrent ? (
        <span class="badge">shown</span>
      ) : (
        <Button kind="plain" disabled={!mayChange} onClick={() => restore(entry.revision)}>
          Restore
        </Button>
      )}
    </li>
  );
}
