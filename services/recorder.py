"""Recording of a node's raw streams: every frame that arrives, until stopped."""

import shutil
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Lock
from typing import Any

from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import CompositeMessage, ControlRequest, Message, StatsMessage
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.request import RequestClient
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.services.files import require_new_recording
from deltalight.services.raw_frames import RAW_STREAMS, RawFrameAssembler
from deltalight.services.relit_pictures import RelitPictures
from deltalight.services.retrying_writer import RetryingWriter, reason
from deltalight.services.stream_queue import StreamQueue

SCENE_TIMEOUT_S = 5.0
POLL_S = 0.1
IDLE_POLLS = 3  # afterwards, frames whose partners are late are taken as they are
SILENCE_S = 3.0
LAST_PICTURE_S = 3.0  # how long a recording that ends waits for the relit picture of its last frame
CHECK_PERIOD_S = 0.5
LEAST_SPACE_S = 60.0
STEADY_AFTER_S = 2.0  # earlier, the rate does not predict the future


@dataclass(frozen=True)
class RecordJob:
    """What to record where; `node` None is the node whose colour picture comes first.

    `composites` is where a render server publishes the relit pictures to keep, None without.
    `duration_s` counts from the first frame. `extrinsics` are the transforms between the sensors, which the streams
    do not carry.
    """

    out: Path
    endpoints: tuple[str, ...]
    node: str | None = None
    scene: SceneDocument | None = None
    extrinsics: Extrinsics | None = None
    duration_s: float | None = None
    frames: int | None = None
    keys: Keys | None = None
    composites: str | None = None

    @property
    def all_endpoints(self) -> tuple[str, ...]:
        """The node's endpoints and the render server's, each once."""
        return tuple(dict.fromkeys((*self.endpoints, *filter(None, (self.composites,)))))


@dataclass
class RecordStatus:
    """Progress of a recording; one thread changes it, others may read.

    `missing` counts frames' parts that never came, by stream: `color` by gaps in the frames' numbers, `depth` and
    `pose` by the frames without. `dropped` counts what came but was left out: messages by stream because the queue
    was full, `late` frames not later than the one before, `broken` messages. `node_drops` is the node's own count of
    drops since the recording began, which is part of `missing`. `unkept` counts frames that came while the disk
    refused, and `disk` is the last sentence about that, empty if it never did.
    """

    out: Path
    frames: int = 0
    composites: int = 0
    seconds: float = 0.0
    size_bytes: int = 0
    free_bytes: int = 0
    cpu_s: float = 0.0
    missing: dict[str, int] = field(default_factory=dict)
    dropped: Counter[str] = field(default_factory=Counter)
    node_drops: int = 0
    unkept: int = 0
    disk: str = ""

    @property
    def bytes_per_s(self) -> float:
        """Mean rate at which the file grows."""
        return self.size_bytes / self.seconds if self.seconds > 0 else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Returns the figures as plain data."""
        seconds = max(self.seconds, 1e-9)
        return {
            "out": str(self.out),
            "frames": self.frames,
            "composites": self.composites,
            "seconds": round(self.seconds, 3),
            "frames_per_s": round(self.frames / seconds, 2) if self.frames else 0.0,
            "bytes": self.size_bytes,
            "mb_per_s": round(self.bytes_per_s / 1e6, 3),
            "missing": self.missing,
            "dropped": dict(self.dropped),
            "node_drops": self.node_drops,
            "unkept": self.unkept,
            "disk": self.disk,
            "cpu_share": round(self.cpu_s / seconds, 3) if self.frames else 0.0,
        }


class Recorder:
    """Records one take.

    `notice(sentence)` reports what the user should read; it is called from the thread of `run`.

    Raises:
        DeltalightError: the name is taken, its folder cannot be written, or an endpoint is malformed.
    """

    def __init__(self, job: RecordJob, notice: Callable[[str], None]) -> None:
        require_new_recording(job.out)
        self.status = RecordStatus(job.out)
        self._job, self._notice = job, notice
        streams = ("stats", *RAW_STREAMS, *(() if job.composites is None else ("composite",)))
        self._queue = StreamQueue(job.all_endpoints, streams, job.keys)
        self._followed: StreamQueue | None = None  # relit pictures of a render server that may be replaced
        self._following = Lock()
        self._assembler = RawFrameAssembler(job.node)
        self._files = ExitStack()
        self._writer: RetryingWriter | None = None
        self._relit = RelitPictures(self._write_composite)
        self._last_ns, self._idle_polls = -1, 0
        self._silent_since_s = self._checked_s = time.monotonic()
        self._is_silent = self._warned_of_space = False
        self._node_drops_before: int | None = None
        self._started_s = self._started_cpu_s = 0.0

    def follow(self, endpoint: str | None) -> None:
        """Keeps the relit pictures of this render server from now on, None = of none; any thread may call it.

        Raises:
            DeltalightError: the endpoint leaves the host without keys, or is malformed.
        """
        queue = None if endpoint is None else StreamQueue((endpoint,), ("composite",), self._job.keys)
        with self._following:
            before, self._followed = self._followed, queue
        if before is not None:
            before.close()

    def run(self, stop: Event) -> RecordStatus:
        """Records until `stop` is set or enough was recorded; without any frame no file is left.

        While the disk refuses, the recording waits, except for its first frame.

        Raises:
            DeltalightError: the disk refused the first frame, refuses at the end, or fails; the sentence says what of
                the recording is readable.
        """
        try:
            with closing(self._queue), self._files:
                while not stop.is_set() and not self._is_enough():
                    self._receive(POLL_S)
                    self._check_progress()
                self._take_rest()
                self._measure()
                if self._writer is not None:
                    self._end(self._writer)
            if self._writer is not None:
                self.status.size_bytes = self._writer.path.stat().st_size
        except DeltalightError as error:
            raise self._explained(error) from error
        except OSError as error:
            raise DeltalightError(
                f"The recording ended because {error.filename} no longer exists ({error.strerror});"
                " start it again."
            ) from error
        return self.status

    def _receive(self, timeout_s: float) -> bool:
        """Takes one message and writes complete frames; returns False if none came."""
        multipart = self._queue.take(timeout_s)
        self._idle_polls = 0 if multipart is not None else self._idle_polls + 1
        try:
            if multipart is not None:
                self._add(*decode(multipart))
            frame = self._assembler.take(is_idle=self._idle_polls >= IDLE_POLLS)
        except DeltalightError as error:
            self._count_broken(error)
            return True
        if frame is not None:
            self._write(frame)
        self._take_followed()
        return multipart is not None or frame is not None

    def _take_followed(self) -> None:
        """Takes the pictures of the render server that is followed; none of them waits for long."""
        with self._following:
            queue = self._followed
        while queue is not None and (multipart := queue.take(0)) is not None:
            self._take_picture(multipart)

    def _take_rest(self) -> None:
        """Writes what arrived before the end and, where relit pictures come, waits for that of the last frame."""
        awaits = self._relit.count > 0 and not self._is_refused()
        if not awaits:
            self._queue.close()  # what it holds can still be taken
        until_s = time.monotonic() + LAST_PICTURE_S
        while not self._is_enough() and self._receive(0) and not (awaits and time.monotonic() > until_s):
            pass
        while awaits and self._relit.lacks_last and time.monotonic() < until_s:
            multipart = self._queue.take(POLL_S)
            self._take_followed()
            if multipart is not None and bytes(multipart[0]).startswith(b"composite."):
                self._take_picture(multipart)

    def _take_picture(self, multipart: ReceivedMultipart) -> None:
        try:
            self._add(*decode(multipart))
        except DeltalightError as error:
            self._count_broken(error)

    def _add(self, message: Message, parts: Sequence[memoryview]) -> None:
        if isinstance(message, CompositeMessage):
            if message.node not in self._assembler.foreign:  # another camera's
                self._relit.add_picture(message, parts)
        elif not isinstance(message, StatsMessage):
            self._assembler.add(message, parts)
        elif message.node == self._assembler.node:
            drops = message.drops.get("capture", 0)
            if self._node_drops_before is None or drops < self._node_drops_before:  # it restarted
                self._node_drops_before = drops - self.status.node_drops
            self.status.node_drops = drops - self._node_drops_before

    def _count_broken(self, error: DeltalightError) -> None:
        if not self.status.dropped["broken"]:
            self._notice(f"Skipping a message: {error}")
        self.status.dropped["broken"] += 1

    def _write(self, frame: SensorFrame) -> None:
        if frame.timestamp_ns <= self._last_ns:
            self.status.dropped["late"] += 1
            return
        if self._writer is None:
            self._writer = self._begin(frame)
        self._last_ns = frame.timestamp_ns
        if self._writer.add(frame):
            self._relit.add_frame(frame.timestamp_ns)
        self._count_written(self._writer)
        self._silent_since_s = time.monotonic()
        if self._is_silent:
            self._is_silent = False
            self._notice("Frames come again.")

    def _write_composite(self, timestamp_ns: int, picture: bytes) -> None:
        assert self._writer is not None  # the frame was written
        self._writer.add_composite(timestamp_ns, picture)
        self._count_written(self._writer)

    def _count_written(self, writer: RetryingWriter) -> None:
        status = self.status
        status.frames, status.composites, status.unkept = writer.frames, writer.composites, writer.unkept

    def _is_refused(self) -> bool:
        return self._writer is not None and self._writer.is_refused

    def _end(self, writer: RetryingWriter) -> None:
        try:
            writer.end()
        finally:
            self._count_written(writer)

    def _tell_of_disk(self, sentence: str) -> None:
        self.status.disk = sentence
        self._notice(sentence)

    def _begin(self, frame: SensorFrame) -> RetryingWriter:
        job, depth = self._job, frame.depth
        if depth is not None and depth.camera != frame.camera and _lacks_place(job.extrinsics):
            self._notice(
                "Depth is not registered to colour and no transform between them is known; the identity will be"
                " used. Name calibration/extrinsics.yaml with --extrinsics."
            )
        self._started_s, self._started_cpu_s = time.monotonic(), time.process_time()
        writer = RecordingWriter(
            job.out, board=self._assembler.board, extrinsics=job.extrinsics, scene=job.scene
        )
        return RetryingWriter(self._files.enter_context(writer), self._tell_of_disk)

    def _is_enough(self) -> bool:
        job, status = self._job, self.status
        if self._writer is None:
            return False
        is_long = job.duration_s is not None and time.monotonic() - self._started_s >= job.duration_s
        return is_long or (job.frames is not None and status.frames >= job.frames)

    def _check_progress(self) -> None:
        now_s = time.monotonic()
        if now_s - self._checked_s < CHECK_PERIOD_S:
            return
        self._checked_s = now_s
        self._measure()
        if self._writer is not None:
            self._writer.try_again()
            self._count_written(self._writer)
        if not self._is_silent and now_s - self._silent_since_s >= SILENCE_S:
            self._is_silent = True
            self._notice(self._silence())
        status = self.status
        if status.seconds >= STEADY_AFTER_S and not (self._warned_of_space or self._is_refused()):
            left_s = status.free_bytes / max(status.bytes_per_s, 1.0)
            if left_s < LEAST_SPACE_S:
                self._warned_of_space = True
                self._notice(f"The disk has room for {left_s:.0f} s more; free some space.")

    def _measure(self) -> None:
        status = self.status
        status.missing = dict(self._assembler.missing)
        for stream, count in self._queue.drops.items():
            status.dropped[stream] = count
        status.free_bytes = shutil.disk_usage(self._job.out.parent).free
        if self._writer is not None:
            status.seconds = time.monotonic() - self._started_s
            status.cpu_s = time.process_time() - self._started_cpu_s
            status.size_bytes = self._writer.active_path.stat().st_size

    def _silence(self) -> str:
        where = " and ".join(self._job.endpoints)
        others = ", ".join(sorted(self._assembler.foreign))
        if self.status.frames:
            return f"No frame came from {where} for {SILENCE_S:g} s; the frames so far are kept. Waiting for more."
        if others:
            return f"No frame of node {self._assembler.node} comes from {where}, only of {others}. Waiting."
        return f"No frame came from {where} for {SILENCE_S:g} s; start a node there or name its endpoint. Waiting."

    def _explained(self, error: DeltalightError) -> DeltalightError:
        active = None if self._writer is None else self._writer.active_path
        if active is None or not self.status.frames:
            if active is not None:
                with suppress(OSError):  # it may have become read-only
                    active.unlink()
            return error
        unkept = f" and {self.status.unkept} frames could not be kept" if self.status.unkept else ""
        return DeltalightError(
            f"The recording ended after {self.status.frames} frames, because {active} could not be written"
            f" ({reason(error)}){unkept}; they are readable there, and `deltalight recordings recover {active}`"
            " finishes it."
        )


def _lacks_place(extrinsics: Extrinsics | None) -> bool:
    return extrinsics is None or extrinsics.depth_from_rgb is None


def scene_of_server(endpoint: str, keys: Keys | None) -> SceneDocument:
    """Requests the scene document from the render server at a control endpoint.

    Raises:
        DeltalightError: it does not answer, or its answer is no scene document.
    """
    client = RequestClient(endpoint, keys=keys)
    try:
        request = ControlRequest(node="recorder", id=uuid.uuid4().hex, op="get_scene")
        reply = client.request(request, SCENE_TIMEOUT_S)
    finally:
        client.close()
    scene = reply.payload.get("scene")
    if reply.error is not None or not isinstance(scene, dict):
        raise DeltalightError(
            f"{endpoint} gives no scene document ({reply.error}); name the control endpoint of a render server."
        )
    return parse_scene(scene, f"the scene of {endpoint}")
