import { shadowTip } from "../../state/shadowLight";
import { tool } from "../../state/tools";

/** What to click for a light from a shadow. */
export function ShadowHint() {
  if (tool.value !== "shadow") return null;
  const text = shadowTip.value
    ? "Now click the point of the real object that casts it. Esc cancels."
    : "Click the tip of a shadow that the camera sees. Esc cancels.";
  return (
    <p class="drop-hint" role="status">
      {text}
    </p>
  );
}
