import { shadowTip } from "../../state/shadowLight";
import { tool } from "../../state/tools";

/** What to click for a light from a shadow. */
export function ShadowHint() {
  if (tool.value !== "shadow") return null;
  const text = shadowTip.value
    ? "Now click the point on the real object that casts it. Press Esc to cancel."
    : "Click the tip of a shadow in the camera's picture. Press Esc to cancel.";
  return (
    <p class="drop-hint" role="status">
      {text}
    </p>
  );
}
