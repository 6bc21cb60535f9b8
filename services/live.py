"""The newest composite, shared by any number of browsers that each take it at their own pace."""

import asyncio
import json
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from protocol.messages import CompositeMessage, StatsMessage

RATE_WINDOW_S = 3.0
STALE_AFTER_S = 2.0


@dataclass(frozen=True)
class LiveFrame:
    """A composite as browsers get it; `number` counts the frames that arrived."""

    number: int
    header: dict[str, Any]
    jpeg: bytes

    def packed(self) -> bytes:
        """One binary message: little-endian uint32 length of the JSON header, the header, the JPEG."""
        header = json.dumps(self.header).encode()
        return struct.pack("<I", len(header)) + header + self.jpeg


class LiveHub:
    """Holds the newest frame only; waiting for a newer one costs nobody else anything (asyncio, one loop)."""

    def __init__(self) -> None:
        self.newest: LiveFrame | None = None
        self.renderer = ""
        self._arrived = asyncio.Event()
        self._arrivals_s: deque[float] = deque()

    def publish(self, message: CompositeMessage, jpeg: bytes) -> None:
        """Make this composite the newest and wake all who wait."""
        self._arrivals_s.append(time.monotonic())
        number = 1 if self.newest is None else self.newest.number + 1
        self.newest = LiveFrame(number, self._header(message), jpeg)
        arrived, self._arrived = self._arrived, asyncio.Event()
        arrived.set()

    def note_stats(self, message: StatsMessage) -> None:
        """Remember what the render server says about itself."""
        self.renderer = message.detail

    async def newer_than(self, number: int) -> LiveFrame:
        """The newest frame, as soon as there is one after `number`; what lies between is skipped."""
        while self.newest is None or self.newest.number <= number:
            await self._arrived.wait()
        return self.newest

    def health(self) -> dict[str, Any]:
        """State of the stream for `/api/v1/health`."""
        if self.newest is None:
            return {"status": "waiting", "frame_id": None, "last_frame_s": None, "frames_per_s": None}
        since_s = time.monotonic() - self._arrivals_s[-1]
        return {
            "status": "ok" if since_s < STALE_AFTER_S else "stale",
            "frame_id": self.newest.header["frame_id"],
            "last_frame_s": round(since_s, 3),
            "frames_per_s": self._frames_per_s(),
        }

    def _header(self, message: CompositeMessage) -> dict[str, Any]:
        return {
            "frame_id": message.frame_id,
            "status": message.status,
            "pass_times_ms": message.pass_times_ms,
            "drops": message.drops,
            "age_ms": age_ms(message),
            "frames_per_s": self._frames_per_s(),
            "renderer": self.renderer,
        }

    def _frames_per_s(self) -> float | None:
        now_s = time.monotonic()
        while len(self._arrivals_s) > 2 and self._arrivals_s[0] < now_s - RATE_WINDOW_S:
            self._arrivals_s.popleft()
        span_s = self._arrivals_s[-1] - self._arrivals_s[0]
        return (len(self._arrivals_s) - 1) / span_s if span_s > 0 else None


def age_ms(message: CompositeMessage) -> float:
    """How long ago the picture was captured, by this host's clock."""
    return (time.time_ns() - message.capture_ns - message.clock_offset_ns) / 1e6
