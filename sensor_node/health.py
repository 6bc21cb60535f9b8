"""Health of a node for its statistics: live, stale or lost, and what else is wrong."""

import time
from collections.abc import Callable, Sequence
from typing import Literal

from deltalight.protocol.frames import BoardPose
from deltalight.sensor_node.cameras.base import Camera

State = Literal["starting", "running", "waiting", "degraded"]


class Health:
    """Watches the frames of one camera.

    Args:
        camera: whose frames these are.
        stale_after_s: age of the newest frame from which the stream is stale; after this time without the board, the
            board counts as out of sight.
        lost_after_s: age of the newest frame from which the camera is lost.
        now_s: a monotonic clock, s.
    """

    def __init__(
        self,
        camera: Camera,
        stale_after_s: float,
        lost_after_s: float,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._camera, self._stale_after_s, self._lost_after_s = camera, stale_after_s, lost_after_s
        self._now_s = now_s
        self._started_s = self._posed_s = now_s()
        self._newest_s: float | None = None

    def note(self, pose: BoardPose | None) -> None:
        """Records that a frame was published, with its pose."""
        self._newest_s = self._now_s()
        if pose is not None:
            self._posed_s = self._newest_s

    def state(self, remarks: Sequence[str] = ()) -> tuple[State, str]:
        """Returns the state on the wire and its sentences: first live, stale or lost, then everything else.

        Args:
            remarks: of others; empty ones are left out.
        """
        state, sentence = self._stream()
        faults = [remark for remark in (self._board(), *remarks) if remark]
        if state == "running" and faults:
            state = "degraded"
        return state, "; ".join([sentence, *faults])

    def _stream(self) -> tuple[State, str]:
        """Returns the camera's own state, else that of the newest frame's age."""
        newest_s = self._started_s if self._newest_s is None else self._newest_s
        state, age_s = self._camera.state, self._now_s() - newest_s
        if state is not None and state.name != "live":
            return ("degraded" if state.name == "lost" else "waiting"), f"{state.name}: {state.detail}"
        if age_s >= self._lost_after_s:
            return "degraded", f"lost: no frame for {age_s:.1f} s"
        if self._newest_s is None:
            return "starting", "no frame yet"
        if age_s >= self._stale_after_s:
            return "waiting", f"stale: the newest frame is {age_s:.1f} s old"
        return "running", "live" if state is None or state.detail == "live" else f"live: {state.detail}"

    def _board(self) -> str:
        if self._newest_s is None or self._camera.board is None:
            return ""
        hidden_s = self._newest_s - self._posed_s
        if hidden_s < self._stale_after_s:
            return ""
        return f"the marker board was not seen for {hidden_s:.1f} s, bring it into view"
