"""Collects composites as a viewer receives them: files, a contact sheet, a video and figures."""

import json
import math
import statistics
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import FileIO
from itertools import pairwise
from pathlib import Path
from struct import unpack
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.codecs import decode_color
from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import append_whole, replacing, unwritable, write_bytes, write_png
from deltalight.protocol.messages import CompositeMessage, ControlRequest, StatsMessage
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import RequestClient
from deltalight.services.live_message import age_ms

CONTROL_TIMEOUT_S = 10.0
SHEET_PICTURES = 20
SHEET_COLUMNS = 5
SHEET_WIDTH = 256
VIDEO_CODEC = "mp4v"  # in every OpenCV wheel, which contains FFmpeg
FALLBACK_RATE = 10.0
LOG_LEVEL_ERROR = 2  # of OpenCV
VIDEO_RATES = (1.0, 60.0)  # frames a second; encoders refuse that of pictures a millisecond apart


class CompositeCollector:
    """Receives composites in the calling thread and, if `out` is given, writes each as it came."""

    def __init__(self, composite_endpoint: str, control_endpoint: str, out: Path | None) -> None:
        self.messages: list[CompositeMessage] = []
        self.ages_ms: list[float] = []
        self.arrivals_s: list[float] = []
        self._out = out
        self._report: StatsMessage | None = None
        self._began_s = time.monotonic()
        self._receiver = Receiver([composite_endpoint], ["composite", "stats"])
        self._client = RequestClient(control_endpoint)
        self._index: FileIO | None = None if out is None else (out / "frames.jsonl").open("wb", buffering=0)

    @property
    def count(self) -> int:
        """Number of composites so far."""
        return len(self.messages)

    @property
    def slowest_s(self) -> float:
        """The longest wait for a composite so far, the first one's included; 0 before it."""
        times_s = [self._began_s, *self.arrivals_s]
        return max((after - before for before, after in pairwise(times_s)), default=0.0)

    def take(self, timeout_s: float, limit: int) -> bool:
        """Takes what arrived within `timeout_s`, up to `limit` composites in total; returns whether there was any."""
        before = self.count
        for multipart in (self._receiver.latest(timeout_s) or {}).values():
            message, parts = decode(multipart)
            if isinstance(message, StatsMessage):
                self._report = message
            elif isinstance(message, CompositeMessage) and self.count < limit:
                self._add(message, parts)
        return self.count > before

    def renderer_name(self) -> str:
        """The OpenGL renderer, as the render server reported it, or that it does not answer."""
        if self._report is not None:
            return self._report.detail
        stats = (self._ask("stats", max(CONTROL_TIMEOUT_S, 2 * self.slowest_s)) or {}).get("stats")
        detail = stats.get("detail") if isinstance(stats, dict) else None
        return str(detail or "unknown: the render server did not answer")

    def _ask(self, op: str, timeout_s: float) -> dict[str, Any] | None:
        """Returns the payload of the render server's reply; None if it does not answer in time."""
        try:
            return self._client.request(
                ControlRequest(node="collector", id=uuid.uuid4().hex, op=op), timeout_s
            ).payload
        except DeltalightError:
            return None

    def frames_per_s(self, first: int = 0) -> float | None:
        """Rate of arrival from composite number `first` on, None below two of them."""
        arrivals_s = self.arrivals_s[first:]
        if len(arrivals_s) < 2:
            return None
        return (len(arrivals_s) - 1) / max(arrivals_s[-1] - arrivals_s[0], 1e-3)

    def write_overview(self) -> None:
        """Writes contact_sheet.png and the video from the pictures in the folder."""
        if self._out is None or not self.messages:
            return
        step = max(1, math.ceil(self.count / SHEET_PICTURES))
        pictures = [self._picture(number) for number in range(0, self.count, step)]
        write_png(self._out / "contact_sheet.png", contact_sheet(pictures))
        self._write_video()

    def close(self) -> None:
        """Closes sockets and files."""
        self._receiver.close()
        self._client.close()
        if self._index is not None:
            self._index.close()

    def _add(self, message: CompositeMessage, parts: Sequence[memoryview]) -> None:
        number = self.count
        self.messages.append(message)
        self.ages_ms.append(age_ms(message))
        self.arrivals_s.append(time.monotonic())
        if self._out is not None and self._index is not None:
            write_bytes(self._out / f"{number:06d}.jpg", bytes(parts[0]))
            append_whole(self._index, f"{json.dumps(self._record(number))}\n".encode())

    def _record(self, number: int) -> dict[str, Any]:
        message = self.messages[number]
        return {
            "picture": number,
            "frame": message.frame_id,
            "capture_ns": message.capture_ns,
            "status": message.status,
            "age_ms": round(self.ages_ms[number], 3),
            "pass_times_ms": message.pass_times_ms,
            "lights": message.lights,
            "drops": message.drops,
        }

    def _picture(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        assert self._out is not None
        jpeg = (self._out / f"{number:06d}.jpg").read_bytes()
        return decode_color(jpeg, "jpeg", self.messages[number].shape)

    def _write_video(self) -> None:
        assert self._out is not None
        height, width = self.messages[0].shape[:2]
        codec = cv2.VideoWriter.fourcc(*VIDEO_CODEC)
        rate = round(float(np.clip(self.frames_per_s() or FALLBACK_RATE, *VIDEO_RATES)), 2)
        with replacing(self._out / "demo.mp4") as path, _no_warnings():
            video = cv2.VideoWriter(str(path), codec, rate, (width, height))
            if not video.isOpened():
                raise DeltalightError(
                    "This OpenCV cannot write mp4; reinstall the package opencv-contrib-python-headless."
                )
            for number in range(self.count):
                frame = cv2.resize(self._picture(number), (width, height))
                video.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            video.release()
            if not _is_whole(path):
                raise unwritable(self._out / "demo.mp4", "it is not whole")


@contextmanager
def _no_warnings() -> Iterator[None]:
    """Keeps OpenCV from warning of each picture that the disk refuses."""
    before = _set_log_level(LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        _set_log_level(before)


def _set_log_level(level: int) -> int:
    """Returns the level of before; OpenCV 5 has the function in a module of its own."""
    setting = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    return int(setting(level))


def _is_whole(path: Path) -> bool:
    """Whether an MP4 file has all its boxes (ISO/IEC 14496-12, 4.2).

    OpenCV does not tell that the disk refused one.
    """
    size, place, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while place < size:
            file.seek(place)
            length, kind = unpack(">I4s", file.read(8).ljust(8, b"\0"))
            if length == 1:  # it follows, because the box is larger than 4 GB
                (length,) = unpack(">Q", file.read(8).ljust(8, b"\0"))
            if length < 8:  # not known yet
                return False
            place += length
            kinds.add(kind)
    return place == size and b"moov" in kinds


def contact_sheet(pictures: list[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the pictures as small tiles in rows; all have the size of the first."""
    height, width = pictures[0].shape[:2]
    tile = (SHEET_WIDTH, round(SHEET_WIDTH * height / width))
    tiles = [cv2.resize(picture, tile, interpolation=cv2.INTER_AREA) for picture in pictures]
    columns = min(SHEET_COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    return np.vstack(rows)


def summarize(collector: CompositeCollector, restarts: dict[str, int]) -> dict[str, Any]:
    """Returns the figures of a finished run; a render server that does not answer only lacks its name.

    `settled_...` are those of the later half, without the start and the first choice of size by a frame budget.
    """
    half = collector.count // 2
    passes: dict[str, list[float]] = {}
    for message in collector.messages:
        for name, milliseconds in message.pass_times_ms.items():
            passes.setdefault(name, []).append(milliseconds)
    return {
        "renderer": collector.renderer_name(),
        "composites": collector.count,
        "without_pose": sum(message.status == "no_pose" for message in collector.messages),
        "frames_per_s": collector.frames_per_s(),
        "settled_frames_per_s": collector.frames_per_s(half),
        "age_median_ms": statistics.median(collector.ages_ms),
        "settled_age_median_ms": statistics.median(collector.ages_ms[half:]),
        "age_p95_ms": float(np.percentile(collector.ages_ms, 95)),
        "drops": collector.messages[-1].drops,
        "restarts": restarts,
        "pass_times_ms": {name: statistics.mean(values) for name, values in passes.items()},
    }
