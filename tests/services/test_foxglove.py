"""`deltalight foxglove`: a client of Foxglove's protocol receives every topic of a recording that is replayed."""

import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from websockets import Subprotocol
from websockets.sync.client import ClientConnection, connect

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.recording_format import FOXGLOVE_TOPICS, matrix_of
from deltalight.protocol.request import ReplyServer
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.source import open_source
from deltalight.services.demo import RECORDING
from deltalight.services.foxglove_bridge import BridgeJob, FoxgloveBridge, FoxgloveServer
from deltalight.services.ports import endpoint, private_ports
from tests.protocol.fisheye_samples import linear
from tests.services.conftest import ROOT, RunCli
from tests.services.record_samples import PERIOD_NS, composite, frames, messages, write

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
PATIENCE_S = 60
FOUND = BoardPose(np.eye(4), reprojection_error_px=0.2)


class Watcher:
    """A client that subscribes to every topic that is advertised."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[int, dict[str, str]] = {}
        self.received: dict[str, tuple[int, bytes]] = {}

    def watch(self, topics: set[str]) -> None:
        """Receives until each topic has had a message."""
        while not topics <= set(self.received):
            message = self._socket.recv(timeout=PATIENCE_S)
            if isinstance(message, bytes):
                opcode, subscription, time_ns = struct.unpack_from("<BIQ", message)
                if opcode == 1:
                    self.received[self.channels[subscription]["topic"]] = time_ns, message[13:]
                continue
            content = json.loads(message)
            if content["op"] == "advertise":
                new = content["channels"]
                self.channels.update({channel["id"]: channel for channel in new})
                asked = [{"id": channel["id"], "channelId": channel["id"]} for channel in new]
                self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))


@contextmanager
def watching(port: int) -> Iterator[Watcher]:
    address, protocol = f"ws://127.0.0.1:{port}", Subprotocol("foxglove.sdk.v1")
    with connect(address, subprotocols=[protocol], max_size=None, max_queue=1 << 16) as socket:
        yield Watcher(socket)


@contextmanager
def replaying(recording: Path) -> Iterator[str]:
    """The endpoint of a node that sends a recording in a loop, and finds every other pose by itself."""
    stop, publisher, source = threading.Event(), Publisher("tcp://127.0.0.1:*"), open_source(recording)

    def run() -> None:
        number = 0
        while not stop.wait(PERIOD_NS / 1e9):
            now_ns = time.time_ns()
            recorded = source[number % len(source)]
            assert recorded.fisheye is not None
            fisheye = replace(recorded.fisheye, timestamp_ns=now_ns)
            frame = replace(
                recorded, frame_id=number, timestamp_ns=now_ns, depth_timestamp_ns=now_ns, fisheye=fisheye
            )
            for multipart in messages(frame, detected=FOUND if number % 2 else None).values():
                publisher.send(multipart)
            publisher.send(composite(frame))
            number += 1

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield publisher.endpoint
    finally:
        stop.set()
        thread.join()
        publisher.close()


@contextmanager
def bridging(*endpoints: str, control: str | None = None) -> Iterator[FoxgloveBridge]:
    stop, said = threading.Event(), list[str]()
    bridge = FoxgloveBridge(BridgeJob(endpoints, "127.0.0.1", 0, control=control), said.append)
    thread = threading.Thread(target=bridge.run, args=(stop,))
    thread.start()
    try:
        yield bridge
    finally:
        stop.set()
        thread.join()
        assert not said


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    recorded = frames(6, with_fisheye=True)
    recorded[5] = replace(recorded[5], fisheye=linear(recorded[5].timestamp_ns))
    return write(tmp_path / "take.mcap", recorded)


def test_a_client_receives_every_topic_of_a_recording(recording: Path, tmp_path: Path) -> None:
    asset = tmp_path / "box.glb"
    trimesh.creation.box((1, 1, 1)).export(asset)
    lamp = {"type": "sphere", "position_m": [0, 1, 2], "intensity": 1}
    scene = parse_scene({"objects": [{"id": "box", "asset": str(asset)}], "lights": {"manual": [lamp]}})
    with ExitStack() as running:
        answer: dict[str, object] = {"scene": scene.model_dump(mode="json")}
        control = running.enter_context(closing(ReplyServer("tcp://127.0.0.1:*", lambda _: answer)))
        node = running.enter_context(replaying(recording))
        bridge = running.enter_context(bridging(node, control=control.endpoint))
        first = running.enter_context(watching(bridge.server.port))
        first.watch(set(FOXGLOVE_TOPICS))
        late = running.enter_context(watching(bridge.server.port))
        late.watch({"/scene"})  # which is sent once, and again to whoever comes later
    for channel in first.channels.values():
        kind = FOXGLOVE_TOPICS[channel["topic"]]
        assert (channel["encoding"], channel["schemaName"]) == ("protobuf", kind.DESCRIPTOR.full_name)
        time_ns, data = first.received[channel["topic"]]
        assert kind.FromString(data).IsInitialized()
        assert abs(time.time_ns() - time_ns) < PATIENCE_S * 1e9
    jpegs = {frame.color_jpeg for frame in open_source(recording)}
    for topic in ("/color/image", "/composite"):
        assert CompressedImage.FromString(first.received[topic][1]).data in jpegs
    entities = {entity.id: entity for entity in SceneUpdate.FromString(late.received["/scene"][1]).entities}
    assert entities["object box"].models[0].data == asset.read_bytes()
    assert entities["light 1"].spheres[0].pose.position.z == 2


def test_a_taken_port_is_told() -> None:
    with closing(FoxgloveServer("127.0.0.1", 0)) as server, pytest.raises(DeltalightError, match="--port"):
        FoxgloveServer("127.0.0.1", server.port)


def test_without_the_package_one_sentence_says_what_to_install(
    cli: RunCli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    done = cli("foxglove", "--port", "0")
    assert done.returncode == 2
    assert "-m pip install foxglove-sdk" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_shipped_recording_is_replayed_by_the_commands() -> None:
    node = endpoint(private_ports(1)[0])
    command = [sys.executable, "-m", "deltalight.services.cli"]
    with ExitStack() as running:

        def start(*words: object) -> "subprocess.Popen[str]":
            line = [*command, *(str(word) for word in words)]
            process = subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, text=True)
            running.enter_context(process)
            running.callback(process.kill)
            return process

        start("replay", RECORDING, "--loop", "--publish", node)
        shown = start("foxglove", "--subscribe", node, "--port", 0)
        assert shown.stdout is not None
        watcher = running.enter_context(watching(int(shown.stdout.readline().rpartition(":")[2])))
        watcher.watch({"/color/image", "/color/calibration", "/depth/image", "/depth/calibration", "/tf"})
    transform = FrameTransform.FromString(watcher.received["/tf"][1])
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "camera")
    assert matrix_of(transform)[2, 3] > 0.3, "the camera is above the table"
