import { delay, DELAY_TIP, delayText } from "../../live/delay";
import { frame, rate, view } from "../../live/picture";
import { droppedFrames, qualityText } from "../../live/message";
import { lensDeviation } from "../../math/camera";
import { milliseconds, rateText } from "../../math/units";
import { uploads } from "../../state/assets";
import { sceneDocument } from "../../state/scene";

// Beyond this share of the picture's width lines that should be straight are visibly bent.
const STRONG = 0.02;

/** Figures of the frame that is shown, and of uploads. */
export function StatusStrip() {
  const header = frame.value;
  const deviation = view.value ? lensDeviation(view.value.lens) : 0;
  return (
    <footer class="status-strip">
      {header && (
        <dl>
          <Figure name="Frame" value={String(header.frame_id)} />
          <Figure
            name="Revision"
            value={String(header.scene?.revision ?? "–")}
            tip="Revision of the scene that this frame shows"
          />
          <Figure name="Delay" value={delayText(delay.value)} tip={DELAY_TIP} />
          <Figure name="Rate" value={rateText(rate.value)} />
          <Figure
            name="Quality"
            value={qualityText(header)}
            tip={budgetText(sceneDocument.value?.output.frame_budget_ms)}
          />
          <Figure name="Dropped" value={String(droppedFrames(header.drops))} tip={dropText(header.drops)} />
          <Figure name="Skipped" value={String(header.skipped)} tip="Frames that this browser was too slow to show" />
        </dl>
      )}
      {deviation > STRONG && <span class="quiet">Wide-angle lens: handles are exact only at their centre</span>}
      <span class="grow" />
      {uploads.value.map((each) => (
        <label class="upload" key={each.id}>
          <span class="cut">{each.share < 1 ? each.name : `Checking ${each.name}`}</span>
          <progress value={each.share < 1 ? each.share : undefined} />
        </label>
      ))}
    </footer>
  );
}

function Figure({ name, value, tip }: { readonly name: string; readonly value: string; readonly tip?: string }) {
  return (
    <div title={tip}>
      <dt>{name}</dt>
      <dd>{value}</dd>
    </div>
  );
}

function budgetText(budget: number | null | undefined): string {
  return budget == null
    ? "While something moves, quality is reduced as far as the method's settings allow"
    : `While something moves, quality and then size are reduced to stay within ${milliseconds(budget)} per frame; at rest the picture has full quality`;
}

function dropText(drops: Readonly<Record<string, number>>): string {
  const lines = Object.entries(drops).filter(([, count]) => count > 0);
  return lines.map(([cause, count]) => `${cause}: ${count}`).join("\n") || "Nothing was dropped";
}
