"""Small frames with everything that a recording can hold, and the messages in which a node sends them."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from deltalight.benchmarks.soak.station import write_take
from deltalight.benchmarks.speed.motions import STANDING
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.envelope import decode, encode
from deltalight.protocol.frames import BoardPose, SensorFrame
from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.pictures import depth_from_steps
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import SceneDocument
from deltalight.sensor_node.frame_messages import (
    Stamps,
    color_multipart,
    depth_multipart,
    fisheye_multipart,
    pose_multipart,
)
from deltalight.services.recorder import Recorder, RecordJob, RecordStatus
from deltalight.services.stream_queue import StreamQueue
from tests.protocol.fisheye_samples import coded

WIDTH, HEIGHT = 72, 54  # no power of two (CONTRIBUTING.md)
PATIENCE_S = 60
STARTED_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_333_333
DEMO_FRAMES_PER_S = 15.0
BOARD = BoardSpec(
    type="aruco_grid", dictionary="DICT_4X4_50", marker_length_m=0.04, separation_m=0.01, rows=3, columns=4
)


def slow_demo(folder: Path, size: tuple[int, int] = (320, 240)) -> Path:
    """Every sixth frame of the demo's recording while its camera stands still: 2.5 a second, not 15, and smaller.

    For tests that wait for pictures of running processes: a node and a renderer of the whole recording keep two cores
    busy all the time. The node of four times as many pixels takes as much of the processor as the renderer.
    """
    out = folder / "demo.mcap"
    write_take(out, size, DEMO_FRAMES_PER_S / 6, STANDING[::6])
    return out


def camera(width: int = WIDTH, height: int = HEIGHT) -> CameraModel:
    matrix = np.array([[60.0, 0, width / 2 - 0.5], [0, 61.0, height / 2 - 0.5], [0, 0, 1]])
    return CameraModel(width, height, matrix)


def frames(count: int, *, as_jpeg: bool = True, with_fisheye: bool = False) -> list[SensorFrame]:
    """Thirty frames a second with depth in millimetres and given poses; a new fish-eye bracket every third.

    Every second JPEG was relit, which left it as it is.
    """
    made: list[SensorFrame] = []
    for index in range(count):
        rng = np.random.default_rng(index)
        color = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (WIDTH, HEIGHT))
        jpeg = cv2.imencode(".jpg", color)[1].tobytes() if as_jpeg else None
        if jpeg is not None:
            color = np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(size=3)
        steps = rng.integers(0, 3000, (HEIGHT, WIDTH)).astype(np.uint16)
        now_ns = STARTED_NS + index * PERIOD_NS
        is_new = with_fisheye and index % 3 == 0
        made.append(
            SensorFrame(
                frame_id=index,
                timestamp_ns=now_ns,
                color=np.ascontiguousarray(color),
                camera=camera(),
                response=np.sort(np.random.default_rng(1).random((256, 3), np.float32), axis=0),
                exposure_s=0.0125,
                depth=depth_from_steps(steps, 0.001, camera(), 0.002),
                depth_timestamp_ns=now_ns,
                world_from_camera=pose,
                color_jpeg=jpeg,
                fisheye=coded(now_ns) if is_new else made[-1].fisheye if made else None,
                composite=jpeg if index % 2 else None,
            )
        )
    return made


def write(path: Path, recorded: Sequence[SensorFrame], scene: SceneDocument | None = None) -> Path:
    shift = np.eye(4)
    shift[0, 3] = 0.05
    extrinsics = Extrinsics(rgb_from_fisheye=shift)
    with RecordingWriter(path, board=BOARD, extrinsics=extrinsics, scene=scene) as writer:
        for frame in recorded:
            writer.add(frame)
    return path


def messages(
    frame: SensorFrame, *, node: str = "cam", detected: BoardPose | None = None
) -> dict[str, list[bytes]]:
    """What a node sends for a frame, by stream in the order of sending."""
    stamps = Stamps(
        node=node,
        frame_id=frame.frame_id,
        capture_ns=frame.timestamp_ns,
        clock_offset_ns=0,
        clock_bound_ns=None,
    )
    sent = {}
    if frame.fisheye is not None:
        own = Stamps(**{**stamps, "capture_ns": frame.fisheye.timestamp_ns})
        sent["fisheye"] = fisheye_multipart(frame.fisheye, own, "raw", 90)
    if frame.depth is not None:
        sent["depth"] = depth_multipart(frame.depth, stamps, "depth", 0.001)
    pose = detected
    if pose is None and frame.world_from_camera is not None:
        pose = BoardPose(frame.world_from_camera)
    sent["pose"] = pose_multipart(pose, BOARD, stamps)
    sent["color"] = color_multipart(frame, stamps, "jpeg" if frame.color_jpeg else "raw", 90)
    return sent


def composite(frame: SensorFrame) -> list[bytes]:
    """What a render server sends for a frame: here the frame's own picture."""
    assert frame.color_jpeg is not None
    message = CompositeMessage(
        node="cam",
        frame_id=frame.frame_id,
        capture_ns=frame.timestamp_ns,
        clock_offset_ns=0,
        encoding="jpeg",
        shape=frame.color.shape,
        status="no_pose",
        camera=frame.camera.to_dict(),
        received_ns=frame.timestamp_ns,
        rendered_ns=frame.timestamp_ns,
    )
    return encode(message, [frame.color_jpeg])


class Feed:
    """A node in a thread: sends frames at 30 a second with rising numbers and times, until told to pause."""

    def __init__(self, publisher: Publisher, node: str = "cam", *, relights: bool = False) -> None:
        self._relights = relights
        self.paused = threading.Event()
        self._publisher, self._node = publisher, node
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        source, number = frames(4), 0
        while not self._closing.wait(PERIOD_NS / 1e9):
            if self.paused.is_set():
                continue
            frame = replace(source[number % 4], frame_id=number, timestamp_ns=time.time_ns())
            for multipart in messages(frame, node=self._node).values():
                self._publisher.send(multipart)
            if self._relights:
                self._publisher.send(composite(frame))
            number += 1


@contextmanager
def feeding(*, relights: bool = False) -> Iterator[tuple[str, Feed]]:
    """The endpoint of a feed that runs, and the feed; one that `relights` sends each picture as relit, too."""
    publisher = Publisher("tcp://127.0.0.1:*")
    feed = Feed(publisher, relights=relights)
    try:
        yield publisher.endpoint, feed
    finally:
        feed.close()
        publisher.close()


class Published:
    """What a node publishes, watched by another subscriber: capture times by frame number."""

    def __init__(self, endpoint: str) -> None:
        self.captured_ns: dict[int, int] = {}
        self._queue = StreamQueue([endpoint], ["color"])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._queue.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            multipart = self._queue.take(0.1)
            if multipart is not None:
                header = decode(multipart)[0]
                self.captured_ns[header.frame_id] = header.capture_ns


def wait_for(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


@contextmanager
def recording(job: RecordJob) -> Iterator[tuple[Recorder, list[str], Future[RecordStatus]]]:
    """A recorder in a thread, what it tells, and its end."""
    notices: list[str] = []
    stop = threading.Event()
    with ThreadPoolExecutor(1) as thread:
        running = Recorder(job, notices.append)
        end = thread.submit(running.run, stop)
        try:
            yield running, notices, end
        finally:
            stop.set()
