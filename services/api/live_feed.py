"""The newest picture of one camera, and how often pictures of it come."""

import time
from collections import deque
from collections.abc import Sequence
from typing import Literal

from deltalight.protocol.messages import CompositeMessage
from deltalight.services.api.live_frame import LiveFrame, LivePicture
from deltalight.services.live_message import PictureHeader

RATE_WINDOW_S = 3.0
STALE_AFTER_S = 2.0


class CameraFeed:
    """Holds only the newest frame. The caller sees that one thread at a time publishes or asks for the rate."""

    def __init__(self) -> None:
        self.newest: LiveFrame | None = None
        self._arrivals_s: deque[float] = deque()

    def publish(
        self, message: CompositeMessage, jpegs: Sequence[bytes], renderer: str, node: str | None
    ) -> LiveFrame:
        """Returns a composite as the newest frame; `node`: the name of its camera, where there are several.

        `jpegs` are its own picture, then those of its `others`.

        Raises:
            DeltalightError: its header is invalid.
        """
        now_s = time.monotonic()
        self._arrivals_s.append(now_s)
        number = 1 if self.newest is None else self.newest.number + 1
        header = PictureHeader.of(
            message, number=number, frames_per_s=self.rate(), renderer=renderer, node=node
        )
        headers = [header, *(header.model_copy(update=dict(other)) for other in message.others)]
        pictures = {
            each.view: LivePicture(each.model_dump_json().encode(), jpeg)
            for each, jpeg in zip(headers, jpegs, strict=True)
        }
        self.newest = LiveFrame(number, message, now_s, time.time_ns(), pictures)
        return self.newest

    def state(self) -> tuple[Literal["waiting", "ok", "stale"], float | None]:
        """Returns whether frames arrive, and the seconds since the newest did."""
        if self.newest is None:
            return "waiting", None
        since_s = time.monotonic() - self.newest.arrived_s
        return ("ok" if since_s < STALE_AFTER_S else "stale"), since_s

    def rate(self) -> float | None:
        """Returns the rate of arrival over the last seconds, 1/s; None before the second frame."""
        now_s = time.monotonic()
        oldest_s = now_s - RATE_WINDOW_S
        while len(self._arrivals_s) > 2 and self._arrivals_s[0] < oldest_s:
            self._arrivals_s.popleft()
        if len(self._arrivals_s) < 2:
            return None
        span_s = now_s - self._arrivals_s[0]  # up to now: the rate falls while frames stay away
        return (len(self._arrivals_s) - 1) / span_s if span_s > 0 else None
