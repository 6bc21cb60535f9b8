"""Fish-eye bracket on disk, node process, server process: the composite is lit from where the lamp is."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64

from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.codecs import decode_color
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.envelope import decode
from deltalight.protocol.messages import CompositeMessage, LightsMessage
from deltalight.protocol.receiver import Receiver
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_camera
from deltalight.services import ports
from tests.sensor_node.fisheye_samples import bracket, equidistant
from tests.services.conftest import ROOT

pytestmark = pytest.mark.slow
PATIENCE_S = 60.0
SIZE = 320, 240
PERIOD_NS = 200_000_000
PLACE_M = (0.2, -0.1, 0.05)
# Towards the lamp, in the fish-eye's frame; its radius in the picture is 3 degrees.
LAMP = np.array([0.5, -0.3, 0.8]) / np.linalg.norm([0.5, -0.3, 0.8])
LAMP_COSINE = np.cos(np.radians(3))
LAMP_RADIANCE, ROOM_RADIANCE = 300.0, 0.1
EXPOSURES_S = 1.0, 1 / 32, 1 / 1024  # white of the shortest is 1024: nothing clips
# The fish-eye is turned about the vertical, so that its axes are not the board's.
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def write_take(folder: Path) -> None:
    """Two frames, five a second, of the synthetic table at rest; the bracket shows an even room with one lamp."""
    lens = equidistant(160)
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(160.0)), axis=-1).reshape(-1, 2)
    is_lamp = (lens.directions(pixels) @ LAMP > LAMP_COSINE).reshape(160, 160, 1)
    light = np.where(is_lamp, LAMP_RADIANCE, ROOM_RADIANCE) * np.ones(3)
    world_from_fisheye = np.eye(4)
    world_from_fisheye[:3, :3], world_from_fisheye[:3, 3] = TURN, PLACE_M
    camera = SyntheticCamera(camera=default_camera().resized(*SIZE))
    extrinsics = Extrinsics(world_from_fisheye=world_from_fisheye)
    with DatasetWriter(folder, board=camera.board, extrinsics=extrinsics) as writer:
        for index in range(2):
            frame = replace(camera.frame_at(0), frame_id=index, timestamp_ns=index * PERIOD_NS)
            pictures = replace(bracket(light, EXPOSURES_S, lens), timestamp_ns=0)
            writer.add(replace(frame, fisheye=pictures))


def write_scene(folder: Path) -> Path:
    """A box on the table, lit by what the fish-eye sees."""
    trimesh.creation.box((0.06, 0.06, 0.06)).export(folder / "box.ply")
    scene = {
        "objects": [{"id": "box", "asset": "box.ply", "pose": {"translation_m": [*PLACE_M[:2], 0.03]}}],
        "lights": {"mode": "fisheye", "fisheye": {"distance_m": "far"}},
        "method": {"volume_size": 32},
        "output": {"width": 160, "height": 120},
    }
    path = folder / "scene.json"
    path.write_text(json.dumps(scene))
    return path


@contextmanager
def command(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A command in a process of its own; Ctrl-C ends it, and it has said nothing that it should not."""
    words = [sys.executable, "-m", "deltalight.services.cli", *map(str, arguments)]
    process = subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert "error" not in said


def lit_composite(receiver: Receiver) -> tuple[CompositeMessage, bytes, LightsMessage]:
    """The first composite that has lights, and the lights that the node sent."""
    deadline_s, sent = time.monotonic() + PATIENCE_S, None
    while time.monotonic() < deadline_s:
        for multipart in (receiver.latest(0.2) or {}).values():
            message, parts = decode(multipart)
            sent = message if isinstance(message, LightsMessage) else sent
            if isinstance(message, CompositeMessage) and message.status == "ok" and message.lights and sent:
                return message, bytes(parts[0]), sent
    raise AssertionError("no composite with lights came")


def degrees_between(one: Float64[np.ndarray, "3"], other: Float64[np.ndarray, "3"]) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def test_a_lamp_in_the_bracket_lights_the_composite_from_its_side(tmp_path: Path) -> None:
    take = tmp_path / "take"
    write_take(take)
    frames, composites, control = map(ports.endpoint, ports.private_ports(3))
    serve = ("server", "--scene", write_scene(tmp_path), "--allow-software", "--subscribe", frames)
    with ExitStack() as stack:
        receiver = Receiver([composites, frames], ["composite", "lights"])
        stack.callback(receiver.close)
        stack.enter_context(command("node", "--source", take, "--loop", "--publish", frames))
        stack.enter_context(command(*serve, "--publish", composites, "--control", control))
        message, data, sent = lit_composite(receiver)
    lamps = [light for light in message.lights if light["type"] == "directional"]
    assert len(lamps) == 1
    assert lamps[0]["id"] == 1
    travels = np.array(lamps[0]["direction"], np.float64)
    assert degrees_between(-travels, TURN @ LAMP) < 1  # a pixel of the fish-eye picture is 1.2 degrees
    (light,) = sent.lights
    assert (-travels).tolist() == np.array(
        light.to_light, np.float32
    ).tolist()  # as the node cut it, to the bit
    assert lamps[0]["angular_radius_deg"] == np.degrees(light.angular_radius_rad)
    assert abs(np.array(lamps[0]["angular_radius_deg"], np.float64) - 3) < 0.5
    assert message.lights[-1]["type"] == "environment"
    picture = decode_color(data, message.encoding, message.shape)
    assert picture.shape == (120, 160, 3)
