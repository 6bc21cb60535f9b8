import { useSignal } from "@preact/signals";
import { API } from "../../api/http";
import { frame } from "../../live/picture";
import { hasPoster, hasPosterBefore } from "../../state/begin";
import { SecureImage } from "../ui/SecureImage";

/** The still that stands for the live picture until it comes; then it fades. A split goes over it, back and forth. */
export function Poster() {
  const isGone = useSignal(frame.value !== null);
  if (!hasPoster.value || isGone.value) return null;
  return (
    <div class={`layer still ${frame.value ? "fading" : ""}`} onTransitionEnd={() => (isGone.value = true)}>
      <SecureImage path={`${API}/poster.jpg`} alt="Still picture" />
      {hasPosterBefore.value && <Before />}
    </div>
  );
}

function Before() {
  return (
    <>
      <SecureImage className="still-before" path={`${API}/poster-before.jpg`} alt="The camera's picture" />
      <div class="still-split" aria-hidden="true" />
      <span class="compare-label left">Before</span>
      <span class="compare-label right">After</span>
    </>
  );
}
