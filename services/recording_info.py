"""Contents of a recording, scanned once without decoding its pictures."""

import mmap
import statistics
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Chunk, Footer, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.recording_format import (
    COMPOSITE_TOPIC,
    FISHEYE_RECORD_TOPIC,
    FRAME_TOPIC,
    FisheyeRecord,
    FrameRecord,
)
from deltalight.protocol.recording_reader import DAMAGE, MAX_RECORD_BYTES, RecordingReader

GAP_PERIODS = 1.5  # a step in time longer than this many usual ones is a gap


@dataclass
class RecordingScan:
    """The records of a recording in order, and the size of every stream before compression.

    `is_finished`: the file has its end; `damaged` counts unreadable chunks, `unread_bytes` what follows the last
    complete record.
    """

    path: Path
    messages: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    frames: list[FrameRecord] = field(default_factory=list)
    fisheyes: list[FisheyeRecord] = field(default_factory=list)
    is_finished: bool = False
    damaged: int = 0
    unread_bytes: int = 0

    @property
    def depth_scale(self) -> float | None:
        """Metres per step of the depth, None if it has none or several."""
        scales = {frame.depth.scale for frame in self.frames if frame.depth is not None}
        return scales.pop() if len(scales) == 1 else None

    @property
    def skipped(self) -> int:
        """Number of frames never recorded, by the gaps in their numbers."""
        steps = [after.frame_id - before.frame_id - 1 for before, after in pairwise(self.frames)]
        return sum(step for step in steps if step > 0)  # it falls when the node restarts


def scan_recording(path: Path, progress: Callable[[float], None] | None = None) -> RecordingScan:
    """Scans a recording, as far as it is readable; `progress` is called with the fraction from 0 to 1.

    Raises:
        DeltalightError: the file cannot be read at all.
    """
    scan = RecordingScan(path)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for message, topic in _messages(data, scan):
                _take(scan, topic, message)
                if progress is not None:
                    progress(data.tell() / data.size())
    except (OSError, ValueError) as error:
        raise DeltalightError(f"{path} cannot be read ({error}); give an .mcap recording.") from error
    scan.frames.sort(key=lambda record: record.timestamp_ns)
    return scan


def _messages(data: mmap.mmap, scan: RecordingScan) -> Iterator[tuple[Message, str]]:
    # Mapped memory returns what exists, however much a damaged length requests.
    topics: dict[int, str] = {}
    whole = 0
    try:
        for record in StreamReader(data, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records:
            whole = data.tell()
            for item in _contents(record, scan):
                if isinstance(item, Channel):
                    topics[item.id] = item.topic
                elif isinstance(item, Message) and item.channel_id in topics:
                    yield item, topics[item.channel_id]
            scan.is_finished = isinstance(record, Footer)
    except DAMAGE:
        scan.unread_bytes = data.size() - whole


def _contents(record: Any, scan: RecordingScan) -> list[Any]:  # noqa: ANN401 - mcap's record classes
    if not isinstance(record, Chunk):
        return [record]
    if record.uncompressed_size > MAX_RECORD_BYTES:
        scan.damaged += 1
        return []
    try:
        contents: list[Any] = breakup_chunk(record, validate_crc=True)
    except DAMAGE:
        scan.damaged += 1
        return []
    return contents


def _take(scan: RecordingScan, topic: str, message: Message) -> None:
    scan.messages[topic] += 1
    scan.bytes[topic] += len(message.data)
    if topic == FRAME_TOPIC:
        scan.frames.append(FrameRecord.unpacked(message.data, str(scan.path)))
    elif topic == FISHEYE_RECORD_TOPIC:
        scan.fisheyes.append(FisheyeRecord.unpacked(message.data, str(scan.path)))


def describe_recording(path: Path, progress: Callable[[float], None] | None = None) -> dict[str, Any]:
    """Returns the contents of a recording as plain data.

    Raises:
        DeltalightError: not a recording, of another schema version, or without a complete frame.
    """
    reader = RecordingReader(path)
    scan = scan_recording(path, progress)
    seconds = (reader.timestamps_ns[-1] - reader.timestamps_ns[0]) / 1e9
    size = path.stat().st_size
    return {
        "file": str(path),
        "bytes": size,
        "is_finished": scan.is_finished,
        "damaged_parts": scan.damaged,
        "unread_bytes": scan.unread_bytes,
        "frames": len(reader),
        "duration_s": seconds,
        "frames_per_s": (len(reader) - 1) / seconds if seconds else None,
        "mb_per_s": size / 1e6 / seconds if seconds else None,
        "first_timestamp_ns": reader.timestamps_ns[0],
        "frames_skipped": scan.skipped,
        **_gaps(reader.timestamps_ns),
        "streams": {
            topic: {"messages": scan.messages[topic], "bytes": scan.bytes[topic]}
            for topic in sorted(scan.messages)
        },
        **_cameras(reader, scan),
        "composites": scan.messages[COMPOSITE_TOPIC],
        "board": None if reader.board is None else reader.board.model_dump(mode="json", exclude_none=True),
        "extrinsics": sorted(reader.extrinsics.to_dict()),
        "scene": None if reader.scene is None else reader.scene.name,
        "notes": reader.notes,
    }


def _gaps(timestamps_ns: list[int]) -> dict[str, Any]:
    steps_s = np.diff(np.array(timestamps_ns, np.int64)) / 1e9
    if not len(steps_s):
        return {"gaps": 0, "longest_gap_s": None}
    return {
        "gaps": int((steps_s > GAP_PERIODS * statistics.median(steps_s)).sum()),
        "longest_gap_s": float(steps_s.max()),
    }


def _cameras(reader: RecordingReader, scan: RecordingScan) -> dict[str, Any]:
    depths = [frame.depth for frame in scan.frames if frame.depth is not None]
    exposures = [frame.exposure_s for frame in scan.frames if frame.exposure_s is not None]
    depth, fisheye = next(iter(depths), None), next(iter(scan.fisheyes), None)
    return {
        "color": {
            "camera": reader.camera.to_dict(),
            "exposure_s": [min(exposures), max(exposures)] if exposures else None,
            "has_response": any(frame.response is not None for frame in scan.frames),
        },
        "depth": None
        if depth is None
        else {
            "camera": depth.camera,
            "scale_m": scan.depth_scale,
            "noise_sigma_m": depth.noise_sigma_m,
            "frames": len(depths),
        },
        "fisheye": None
        if fisheye is None
        else {
            "lens": fisheye.calibration["lens"],
            "pictures": len(scan.fisheyes),
            "exposures_s": fisheye.exposures_s,
            "has_response": fisheye.response is not None,
        },
        "given_poses": sum(frame.world_from_camera is not None for frame in scan.frames),
    }
