import { Picture } from "./Picture";
import { StageBar } from "./StageBar";
import { StatusStrip } from "./StatusStrip";

export function Stage() {
  return (
    <main class="stage" aria-label="Live picture and tools">
      <StageBar />
      <Picture />
      <StatusStrip />
    </main>
  );
}
