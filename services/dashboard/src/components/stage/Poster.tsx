import { useSignal } from "@preact/signals";
import { API } from "../../api/http";
import { frame } from "../../live/picture";
import { hasPoster } from "../../state/begin";
import { SecureImage } from "../ui/SecureImage";

/** The still that stands for the live picture until it comes; then it fades. */
export function Poster() {
  const isGone = useSignal(frame.value !== null);
  if (!hasPoster.value || isGone.value) return null;
  return (
    <div class={`layer still ${frame.value ? "fading" : ""}`} onTransitionEnd={() => (isGone.value = true)}>
      <SecureImage path={`${API}/poster.jpg`} alt="Still picture" />
    </div>
  );
}
