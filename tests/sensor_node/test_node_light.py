"""What a node says about light and about itself: fish-eye, radiance, lamps, its sentences; encrypted too."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.envelope import decode
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import BoardPose, FisheyePictures
from deltalight.protocol.keys import create_keys, load_keys, trust
from deltalight.protocol.messages import (
    FisheyeMessage,
    LampsMessage,
    LightsMessage,
    Message,
    PoseMessage,
    RadianceMessage,
    StatsMessage,
)
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.scene_lights import LightCut
from deltalight.sensor_node import node
from deltalight.sensor_node.cameras.base import Camera, StreamState
from deltalight.sensor_node.cameras.settings import CameraSettings, FisheyeSettings
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_board
from deltalight.sensor_node.health import Health
from deltalight.sensor_node.node import NodeConfig, Repeater, run_node
from deltalight.sensor_node.pose_filter import PoseFilterSettings
from deltalight.services import ports

PERIOD_NS = 200_000_000  # so long that a busy machine also takes several frames under one sky
SIZE = 96
LIMIT_S = 20.0


def pictures(timestamp_ns: int, brightness: float) -> FisheyePictures:
    """One linear picture of an even sky."""
    matrix = np.array([[SIZE / np.pi, 0, SIZE / 2 - 0.5], [0, SIZE / np.pi, SIZE / 2 - 0.5], [0, 0, 1]])
    lens = EquidistantLens(CameraModel(SIZE, SIZE, matrix, "equidistant", np.zeros(4)))
    picture = np.full((SIZE, SIZE, 3), brightness, np.float32)
    return FisheyePictures(timestamp_ns, (picture,), (None,), FisheyeCalibration(lens))


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames; the second fish-eye pictures come with the fourth. A lamp's marker is the board's neighbour."""
    camera = SyntheticCamera()
    path = tmp_path_factory.mktemp("light") / "take"
    above = np.eye(4)
    above[2, 3] = 0.3
    with DatasetWriter(
        path, board=tracked_board(), extrinsics=Extrinsics(world_from_fisheye=above)
    ) as writer:
        for index in range(6):
            sky = pictures(PERIOD_NS * (3 * (index // 3)), 0.5 if index < 3 else 0.25)
            frame = camera.frame_at(index)
            writer.add(replace(frame, timestamp_ns=PERIOD_NS * index, fisheye=sky))
    return path


def tracked_board() -> BoardSpec:
    """The synthetic scene's board, whose last row is said to be a lamp's marker and two that are nowhere."""
    board = default_board()
    lamp = {"id": board.marker_ids[-1], "marker_length_m": board.marker_length_m}
    return board.replaced(rows=2, lamp_markers=[lamp])


@contextmanager
def messages_of(
    config: NodeConfig, topics: list[str]
) -> Iterator[Callable[[Callable[[list[Message]], bool]], list[Message]]]:
    """A node in a thread; `collect(enough)` gives what it publishes."""
    stop = threading.Event()
    thread = threading.Thread(target=run_node, args=(config, stop))
    thread.start()
    receiver = Receiver([config.endpoint], topics)

    def collect(enough: Callable[[list[Message]], bool]) -> list[Message]:
        got: list[Message] = []
        deadline = time.monotonic() + LIMIT_S
        while not enough(got) and time.monotonic() < deadline:
            got += [decode(multipart)[0] for multipart in (receiver.latest(0.2) or {}).values()]
        assert enough(got), [message.stream for message in got]
        return got

    try:
        yield collect
    finally:
        stop.set()
        thread.join(20)
        receiver.close()
        assert not thread.is_alive()


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/node"


def lights_of(messages: list[Message]) -> list[LightsMessage]:
    return [message for message in messages if isinstance(message, LightsMessage)]


def test_light_goes_out_when_it_is_new_and_again_for_whoever_comes_late(
    take: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node, "REPEAT_S", 0.3)
    config = NodeConfig(source=str(take), endpoint=endpoint, lights=LightCut(smoothing_s=0.05))

    def repeated(got: list[Message]) -> bool:
        """Maps, and lights that followed one in more than one step."""
        steps = {(message.radiance_capture_ns, message.capture_ns) for message in lights_of(got)}
        maps = sum(isinstance(message, RadianceMessage) for message in got)
        return maps >= 4 and len({of_map for of_map, _ in steps}) < len(steps)

    with messages_of(config, ["fisheye", "radiance", "lights"]) as collect:
        got = collect(repeated)
    lights = lights_of(got)
    maps = [message for message in got if isinstance(message, RadianceMessage)]
    raw = [message for message in got if isinstance(message, FisheyeMessage)]
    assert maps[0].world_from_fisheye[2][3] == pytest.approx(0.3)
    assert raw[0].dtype == "float32"
    assert len({message.capture_ns for message in maps}) >= 2
    assert raw[0].capture_ns <= maps[-1].capture_ns
    cut = {(message.radiance_frame_id, message.radiance_capture_ns) for message in lights}
    assert {(message.frame_id, message.capture_ns) for message in maps[:-1]} <= cut
    assert all((message.count, message.smoothing_s) == (4, 0.05) for message in lights)
    assert all(message.world_from_fisheye == maps[0].world_from_fisheye for message in lights)


def test_lamps_go_out_with_each_frame(take: Path, endpoint: str) -> None:
    config = NodeConfig(source=str(take), endpoint=endpoint)

    def both(got: list[Message]) -> bool:
        return any(isinstance(message, LampsMessage) for message in got) and any(
            isinstance(message, PoseMessage) for message in got
        )

    with messages_of(config, ["lamps", "pose"]) as collect:
        got = collect(both)
    lamps = next(message for message in got if isinstance(message, LampsMessage))
    (lamp,) = lamps.lamps
    board = default_board()
    assert lamp.marker == board.marker_ids[-1]
    middle = board.corner_points()[lamp.marker].mean(axis=0)
    assert np.array(lamp.world_from_marker)[:3, 3] == pytest.approx(middle, abs=0.004)


def test_fish_eye_pictures_may_come_from_another_source(take: Path, endpoint: str, tmp_path: Path) -> None:
    camera, plain = SyntheticCamera(), tmp_path / "plain"
    with DatasetWriter(plain, board=camera.board) as writer:
        for index in range(2):
            writer.add(camera.frame_at(index))
    fisheye = FisheyeSettings(source=str(take), camera=CameraSettings(loop=True))
    config = NodeConfig(source=str(plain), endpoint=endpoint, fisheye=fisheye)
    with messages_of(config, ["fisheye", "stats"]) as collect:
        got = collect(lambda got: {message.stream for message in got} == {"fisheye", "stats"})
    stats = [message for message in got if isinstance(message, StatsMessage)]
    assert stats[-1].state == "degraded"  # its place is not known, so it is no light yet
    assert "calibration/extrinsics.yaml" in stats[-1].detail


def test_an_overexposed_fish_eye_is_told_and_the_stream_goes_on(tmp_path: Path, endpoint: str) -> None:
    camera, path = SyntheticCamera(), tmp_path / "bright"
    sky = pictures(0, 0.5)
    coded = replace(sky, pictures=(np.full((SIZE, SIZE, 3), 255, np.uint8),))
    with DatasetWriter(
        path, board=camera.board, extrinsics=Extrinsics(world_from_fisheye=np.eye(4))
    ) as writer:
        for index in range(2):
            writer.add(replace(camera.frame_at(index), fisheye=coded))
    with messages_of(NodeConfig(source=str(path), endpoint=endpoint), ["stats", "color"]) as collect:
        got = collect(lambda got: any("overexposed" in getattr(message, "detail", "") for message in got))
        stats = next(message for message in got if "overexposed" in getattr(message, "detail", ""))
        assert isinstance(stats, StatsMessage)
        assert stats.state == "degraded"
        assert stats.detail.startswith("live; ")
        collect(lambda got: any(message.stream == "color" for message in got))


def test_a_filtered_pose_goes_out_only_where_it_is_asked_for(take: Path, endpoint: str) -> None:
    def poses(config: NodeConfig) -> dict[int, np.ndarray]:
        """Poses by frame of the take, which is played again and again."""
        with messages_of(config, ["pose"]) as collect:
            got = collect(lambda got: len({message.frame_id % 6 for message in got}) >= 4)
        return {m.frame_id % 6: np.array(m.world_from_camera) for m in got if isinstance(m, PoseMessage)}

    plain = NodeConfig(source=str(take), endpoint=endpoint)
    raw, again = poses(plain), poses(plain)
    smooth = poses(plain.replaced(pose_filter=PoseFilterSettings(min_cutoff_hz=0.1, beta=0.0)))
    assert max(np.abs(smooth[index] - raw[index]).max() for index in raw.keys() & smooth.keys()) > 1e-4
    assert max(np.abs(again[index] - raw[index]).max() for index in raw.keys() & again.keys()) == 0


def test_a_node_with_keys_is_heard_by_those_it_trusts(take: Path, tmp_path: Path) -> None:
    for name in ("node", "server"):
        create_keys(name, tmp_path / name)
    node, server = (
        replace(load_keys(name, tmp_path / name), on_loopback=True) for name in ("node", "server")
    )
    trust(tmp_path / "server" / "server.key", node.folder)
    trust(tmp_path / "node" / "node.key", server.folder)
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    stop = threading.Event()
    thread = threading.Thread(
        target=run_node, args=(NodeConfig(source=str(take), endpoint=endpoint), stop, node)
    )
    thread.start()
    stranger, receiver = (
        Receiver([endpoint], ["stats"]),
        Receiver([endpoint.replace("//", "//node@")], ["stats"], keys=server),
    )
    try:
        refused = 0
        deadline = time.monotonic() + LIMIT_S
        while not refused and time.monotonic() < deadline:
            for multipart in (receiver.latest(0.5) or {}).values():
                message, _ = decode(multipart)
                assert isinstance(message, StatsMessage)
                refused = message.drops["connections_refused"]
        assert refused > 0
        assert stranger.latest(0) is None
    finally:
        stop.set()
        thread.join(20)
        stranger.close()
        receiver.close()


class SaidCamera(SyntheticCamera):
    """A camera that says of itself what the test wants."""

    said: StreamState | None = None

    @property
    def state(self) -> StreamState | None:
        return self.said


def test_the_states_of_a_camera_are_the_nodes_with_a_sentence_each() -> None:
    camera = SaidCamera()
    health = Health(camera, stale_after_s=60, lost_after_s=120)
    assert health.state() == ("starting", "no frame yet")
    health.note(BoardPose(np.eye(4)))
    assert health.state() == ("running", "live")
    for name, state in (("stale", "waiting"), ("lost", "degraded")):
        camera.said = StreamState(name, "uvc:0 was unplugged (trying again in 2 s)")  # type: ignore[arg-type]
        assert health.state() == (state, f"{name}: uvc:0 was unplugged (trying again in 2 s)")
    camera.said = StreamState("live", "uvc:0: exposure cannot be locked")
    assert health.state() == ("running", "live: uvc:0: exposure cannot be locked")
    camera.said = None
    assert health.state(["", "a clock was set"]) == ("degraded", "live; a clock was set")


def test_a_lost_board_and_old_frames_are_told() -> None:
    now_s = [100.0]
    health = Health(SyntheticCamera(), stale_after_s=0.5, lost_after_s=5, now_s=lambda: now_s[0])
    health.note(BoardPose(np.eye(4)))
    now_s[0] += 0.7
    assert health.state() == ("waiting", "stale: the newest frame is 0.7 s old")
    health.note(None)
    sentence = "the marker board was not seen for 0.7 s, bring it into view"
    assert health.state() == ("degraded", f"live; {sentence}")
    health.note(BoardPose(np.eye(4)))
    assert health.state() == ("running", "live")
    now_s[0] += 6
    assert health.state() == ("degraded", "lost: no frame for 6.0 s")


def test_a_repeater_makes_a_message_once_for_each_object(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[list[int]] = []
    sent: list[list[bytes]] = []

    def message_of(item: list[int]) -> list[bytes]:
        made.append(item)
        return [bytes(item)]

    repeats = Repeater[list[int]]()
    first, second = [1], [1]
    for item in (first, first, second, second, first):
        repeats.send(item, partial(message_of, item), sent.append)
    assert len(made) == len(sent) == 3
    monkeypatch.setattr(node, "REPEAT_S", 0.0)
    repeats.send(first, lambda: [b"not made again"], sent.append)
    assert len(sent) == 4
    assert sent[-1] == sent[-2]
    monkeypatch.setattr(node, "REPEAT_S", 99.0)
    assert not repeats.send(first, lambda: [b"not made again"], sent.append)
    assert repeats.send(first, lambda: [b"not made again"], sent.append, now=True)
    assert len(sent) == 5


def test_a_camera_of_a_node_is_told_to_replay_by_the_node_itself() -> None:
    assert isinstance(SyntheticCamera(), Camera)
    with pytest.raises(ValueError, match="write `loop` into the node's settings"):
        NodeConfig(camera=CameraSettings(loop=False))
