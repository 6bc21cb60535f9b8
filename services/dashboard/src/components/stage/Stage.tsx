import { Picture } from "./Picture";
import { isRoomShown } from "../../state/tools";
import { RoomView } from "./RoomView";
import { StageBar } from "./StageBar";
import { StatusStrip } from "./StatusStrip";

export function Stage() {
  return (
    <main class="stage" aria-label="Live picture and tools">
      <StageBar />
      {isRoomShown.value ? <RoomView /> : <Picture />}
      <StatusStrip />
    </main>
  );
}
