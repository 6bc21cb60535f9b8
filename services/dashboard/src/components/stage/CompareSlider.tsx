import { useSignal } from "@preact/signals";
import { useRef } from "preact/hooks";
import { comparison } from "../../state/comparison";
import { IconButton } from "../ui/IconButton";
import { SecureImage } from "../ui/SecureImage";

/** Two pictures of one frame over the live one; the split is dragged, or moved by arrow keys. */
export function CompareSlider() {
  const split = useSignal(50);
  const root = useRef<HTMLDivElement>(null);
  const shown = comparison.value;
  if (!shown) return null;
  const follow = (event: PointerEvent): void => {
    const outline = root.current?.getBoundingClientRect();
    if (outline && event.buttons === 1)
      split.value = Math.max(0, Math.min(100, (100 * (event.clientX - outline.left)) / outline.width));
  };
  return (
    <div
      class="compare"
      ref={root}
      onPointerDown={(event) => {
        if ((event.target as Element).closest("button")) return;
        event.currentTarget.setPointerCapture(event.pointerId);
        follow(event);
      }}
      onPointerMove={follow}
      style={{ "--split": `${split.value}%` }}
    >
      <SecureImage className="compare-b" path={shown.b.path} alt={shown.b.label} />
      <SecureImage className="compare-a" path={shown.a.path} alt={shown.a.label} />
      <span class="compare-label left">{shown.a.label}</span>
      <span class="compare-label right">{shown.b.label}</span>
      <div class="compare-split" aria-hidden="true" />
      <input
        class="compare-range"
        type="range"
        aria-label={`Split between ${shown.a.label} and ${shown.b.label}`}
        min={0}
        max={100}
        step={0.5}
        value={split.value}
        onInput={(event) => (split.value = event.currentTarget.valueAsNumber)}
      />
      <div class="compare-close">
        <span>Frame {shown.frameId}</span>
        <IconButton icon="close" label="Back to the live picture" onClick={() => (comparison.value = null)} />
      </div>
    </div>
  );
}
