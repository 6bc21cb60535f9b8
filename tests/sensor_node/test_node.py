"""The node's loop: what it publishes, in which order, and that it ends."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.clock import CLOCK_OP, clock_payload
from deltalight.protocol.codecs import decode_color, decode_depth
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.messages import (
    ColorMessage,
    ControlRequest,
    DepthMessage,
    Message,
    PoseMessage,
    StatsMessage,
)
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import ReplyServer
from deltalight.protocol.sockets import open_context
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_camera
from deltalight.sensor_node.capture import CaptureThread
from deltalight.sensor_node.frame_messages import depth_multipart, fitting_step_m
from deltalight.sensor_node.node import NodeConfig, run_node
from tests.sensor_node.conftest import pose_difference

Received = list[tuple[Message, list[memoryview]]]


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames whose colour is JPEG."""
    camera = SyntheticCamera()
    path = tmp_path_factory.mktemp("node") / "take"
    with DatasetWriter(path, board=camera.board) as writer:
        for index in range(6):
            writer.add(camera.frame_at(index))
    lines = []
    for line in (path / "rgb.txt").read_text().splitlines():
        if not line.startswith("#"):
            picture = path / line.split()[1]
            cv2.imwrite(str(picture.with_suffix(".jpg")), cv2.imread(str(picture)))
            lines.append(line.replace(".png", ".jpg"))
    (path / "rgb.txt").write_text("\n".join(lines) + "\n")
    return path


@contextmanager
def running(config: NodeConfig) -> Iterator[threading.Event]:
    """A node in a thread; leaving stops it and says how it ended."""
    stop, errors = threading.Event(), []

    def run() -> None:
        try:
            run_node(config, stop)
        except Exception as error:  # raised again below
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield stop
    finally:
        stop.set()
        thread.join(20)
        assert not thread.is_alive(), "the node did not end"
    if errors:
        raise errors[0]


def collect(receiver: Receiver, enough: Callable[[Received], bool], limit_s: float = 20) -> Received:
    messages: Received = []
    deadline = time.monotonic() + limit_s
    while not enough(messages) and time.monotonic() < deadline:
        messages += [decode(multipart) for multipart in (receiver.latest(0.2) or {}).values()]
    assert enough(messages), [type(message).__name__ for message, _ in messages]
    return messages


def kinds(messages: Received) -> set[str]:
    return {message.stream for message, _ in messages}


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/node"


def test_a_node_publishes_every_stream_of_a_frame_with_one_id_and_time(take: Path, endpoint: str) -> None:
    with running(NodeConfig(name="desk", source=str(take), endpoint=endpoint)):
        receiver = Receiver([endpoint], [])
        streams = {"color", "depth", "clean_depth", "pose", "stats"}
        messages = collect(receiver, lambda got: kinds(got) >= streams and len(got) > 30)
        receiver.close()
    by_capture: dict[int, dict[str, tuple[Message, list[memoryview]]]] = {}
    for message, parts in messages:
        by_capture.setdefault(message.capture_ns, {})[message.stream] = (message, parts)
    whole = next(group for group in by_capture.values() if len(group) == 4)
    assert len({message.frame_id for message, _ in whole.values()}) == 1
    color, pose, clean = whole["color"][0], whole["pose"][0], whole["clean_depth"][0]
    assert isinstance(color, ColorMessage)
    assert isinstance(pose, PoseMessage)
    assert isinstance(clean, DepthMessage)
    index = color.frame_id % 6
    assert bytes(whole["color"][1][0]) == sorted((take / "rgb").glob("*.jpg"))[index].read_bytes()
    truth = SyntheticCamera().pose_at(index)
    assert pose.status == "ok"
    metres, degrees = pose_difference(np.array(pose.world_from_camera), truth)
    assert metres < 0.003
    assert degrees < 0.3
    depth_m, valid = decode_depth(
        whole["clean_depth"][1][0], clean.encoding, clean.shape, clean.depth_scale_m
    )
    exact = SyntheticCamera().frame_at(index).depth
    assert exact is not None
    assert np.median(np.abs(depth_m - exact.depth_m)[valid]) < 0.001
    assert abs(time.time_ns() - color.capture_ns) < 60e9
    stats = next(message for message, _ in messages if isinstance(message, StatsMessage))
    assert stats.state == "running"
    assert stats.detail == "live"
    assert stats.rates["fps"] > 1


def test_colour_comes_after_what_belongs_to_it(endpoint: str, take: Path) -> None:
    import zmq

    context = open_context()
    socket = context.socket(zmq.SUB)
    socket.rcvhwm = 1000
    socket.subscribe("")
    socket.connect(endpoint)
    with running(NodeConfig(source=str(take), endpoint=endpoint)):
        order: list[str] = []
        while len(order) < 12:
            message, _ = decode(socket.recv_multipart())
            if message.stream != "stats":
                order.append(message.stream)
    context.destroy(0)
    start = order.index("depth")
    assert order[start : start + 4] == ["depth", "clean_depth", "pose", "color"]


def test_a_node_ends_with_its_source_and_sends_raw_pictures_if_asked(take: Path, endpoint: str) -> None:
    run_node(NodeConfig(source=str(take), endpoint=endpoint, realtime=False, loop=False), threading.Event())
    with running(NodeConfig(source=str(take), endpoint=endpoint, color_encoding="raw")):
        receiver = Receiver([endpoint], ["color"])
        messages = collect(receiver, lambda got: len(got) > 0)
        receiver.close()
    message, parts = messages[0]
    assert isinstance(message, ColorMessage)
    picture = decode_color(parts[0], "raw", message.shape)
    jpegs = sorted((take / "rgb").glob("*.jpg"))
    expected = cv2.cvtColor(cv2.imread(str(jpegs[message.frame_id % 6])), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(picture, expected)


def test_a_capture_thread_keeps_all_or_the_newest() -> None:
    def captured(*, keep_all: bool) -> tuple[list[int], int]:
        camera = SyntheticCamera(camera=CameraModel(64, 48, np.diag([50.0, 50, 1])), loop=False)
        ids = []
        with camera, CaptureThread(camera, keep_all=keep_all) as capture:
            while not capture.ended:
                time.sleep(0 if keep_all else 0.02)
                taken = capture.take(0.1)
                ids += [] if taken is None else [taken.frame.frame_id]
        return ids, capture.drops

    assert captured(keep_all=True) == (list(range(90)), 0)
    ids, drops = captured(keep_all=False)
    assert len(ids) + drops == 90
    assert drops > 0
    assert ids == sorted(ids)


def test_the_servers_clock_is_followed(take: Path, endpoint: str, tmp_path: Path) -> None:
    ahead_ns = 3_000_000_000

    def answer(request: ControlRequest) -> dict[str, object]:
        assert request.op == CLOCK_OP
        return clock_payload(time.time_ns() + ahead_ns, lambda: time.time_ns() + ahead_ns)

    server = ReplyServer(f"ipc://{tmp_path}/control", answer)
    config = NodeConfig(source=str(take), endpoint=endpoint, clock_endpoint=server.endpoint)

    def compared(got: Received) -> bool:
        return any(isinstance(m, ColorMessage) and m.clock_bound_ns is not None for m, _ in got)

    with running(config):
        receiver = Receiver([endpoint], ["color"])
        messages = collect(receiver, compared)
        receiver.close()
    server.close()
    message = next(m for m, _ in messages if m.clock_bound_ns is not None)
    assert message.clock_bound_ns is not None
    assert abs(message.clock_offset_ns - ahead_ns) <= message.clock_bound_ns


def test_a_board_out_of_sight_is_told_and_is_no_error(tmp_path: Path, endpoint: str) -> None:
    from dataclasses import replace

    camera = SyntheticCamera()
    path = tmp_path / "blank"
    with DatasetWriter(path, board=camera.board) as writer:
        for index in range(2):
            writer.add(replace(camera.frame_at(index), color=np.full((480, 640, 3), 80, np.uint8)))
    with running(NodeConfig(source=str(path), endpoint=endpoint)):
        receiver = Receiver([endpoint], ["pose", "color"])
        messages = collect(receiver, lambda got: kinds(got) >= {"pose", "color"})
        receiver.close()
    pose = next(message for message, _ in messages if isinstance(message, PoseMessage))
    assert pose.status == "no_board"
    assert pose.board is not None


def test_an_unknown_source_is_a_sentence(endpoint: str) -> None:
    with pytest.raises(DeltalightError, match="no file, folder or camera `nowhere`"):
        run_node(NodeConfig(source="nowhere", endpoint=endpoint), threading.Event())


def test_a_frame_that_breaks_is_raised_from_the_node(take: Path, endpoint: str, tmp_path: Path) -> None:
    import shutil

    broken = tmp_path / "broken"
    shutil.copytree(take, broken)
    sorted((broken / "rgb").glob("*.jpg"))[2].write_bytes(b"no picture")
    config = NodeConfig(source=str(broken), endpoint=endpoint, realtime=False, loop=False)
    with pytest.raises(DeltalightError):
        run_node(config, threading.Event())


@pytest.mark.parametrize(("farthest", "step"), [(0.5, 0.0001), (6.5, 0.0001), (6.6, 0.0002), (30.0, 0.0008)])
def test_depth_goes_out_in_the_finest_step_that_its_range_fits(farthest: float, step: float) -> None:
    camera = default_camera()
    depth_m = np.full((480, 640), 0.3, np.float32)
    depth_m[0, 0] = farthest
    depth = DepthImage(depth_m, depth_m > 0, camera)
    assert fitting_step_m(depth) == pytest.approx(step)
    stamps = {"node": "a", "frame_id": 1, "capture_ns": 2, "clock_offset_ns": 0, "clock_bound_ns": None}
    message, parts = decode(depth_multipart(depth, stamps, "clean_depth"))  # type: ignore[arg-type]
    assert isinstance(message, DepthMessage)
    got, valid = decode_depth(parts[0], message.encoding, message.shape, message.depth_scale_m)
    assert valid.all()
    assert np.abs(got - depth_m).max() <= 0.51 * step
