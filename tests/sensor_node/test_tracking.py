"""OpenTrackIO: packets by the standard, coordinates, lenses, and a node's camera that is tracked over real UDP."""

import json
import math
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.sensor_node.node import NodeConfig, node_camera
from deltalight.sensor_node.tracking.cbor import CborError, decode_cbor
from deltalight.sensor_node.tracking.opentrackio import PacketReader, Sample, fletcher16, tracked_lens
from deltalight.sensor_node.tracking.receiver import TrackingReceiver, TrackingSettings
from deltalight.sensor_node.tracking.tracked_camera import TrackedCamera

JSON, CBOR, LAST = 1, 2, 0x8000
PATIENCE_S = 20


def sample(**changes: Any) -> dict[str, Any]:  # noqa: ANN401
    camera = {
        "id": "Camera",
        "translation": {"x": 1.0, "y": 2.0, "z": 3.0},
        "rotation": {"pan": 0.0, "tilt": 0.0, "roll": 0.0},
    }
    return {"protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]}, "transforms": [camera], **changes}


def turned(**angles: float) -> dict[str, Any]:
    made = sample()
    made["transforms"][0]["rotation"].update(angles)
    return made


def packet(
    payload: bytes, sequence: int = 0, *, encoding: int = JSON, offset: int = 0, flag: int = LAST
) -> bytes:
    head = struct.pack(">4sBBHIH", b"OTrk", 0, encoding, sequence, offset, flag | len(payload))
    return head + struct.pack(">H", fletcher16(head + payload)) + payload


def of_json(values: dict[str, Any], sequence: int = 0) -> bytes:
    return packet(json.dumps(values).encode(), sequence)


def pose_of(values: dict[str, Any]) -> np.ndarray:
    pose = Sample.model_validate(values).stage_from_camera
    assert pose is not None
    return pose


def test_the_checksum_is_that_of_the_standard() -> None:
    """The known values of Fletcher-16 with modulus 256, second sum first."""
    assert fletcher16(b"abcde") == 0xC3EF  # by hand: sums 0x1EF and 0x5C3
    assert fletcher16(bytes(range(256)) * 5) == _slow_sums(bytes(range(256)) * 5)


def _slow_sums(data: bytes) -> int:
    first = second = 0
    for value in data:
        first = (first + value) % 256
        second = (second + first) % 256
    return second << 8 | first


def test_a_camera_at_rest_looks_along_y_with_z_up() -> None:
    pose = pose_of(sample())
    np.testing.assert_allclose(pose[:3, 3], (1, 2, 3))
    np.testing.assert_allclose(pose[:3, :3] @ (0, 0, 1), (0, 1, 0))  # forward
    np.testing.assert_allclose(pose[:3, :3] @ (1, 0, 0), (1, 0, 0))  # right
    np.testing.assert_allclose(pose[:3, :3] @ (0, -1, 0), (0, 0, 1))  # up


@pytest.mark.parametrize(
    ("angles", "forward", "right"),
    [
        ({"pan": 90}, (-1, 0, 0), (0, 1, 0)),  # to the left, clockwise about z as seen from the origin
        ({"tilt": 90}, (0, 0, 1), (1, 0, 0)),  # upwards
        ({"roll": 90}, (0, 1, 0), (0, 0, -1)),  # the right side goes down
        ({"pan": 90, "tilt": 90}, (0, 0, 1), (0, 1, 0)),  # tilt about the axis that pan has turned
        ({"tilt": 90, "roll": 90}, (0, 0, 1), (0, 1, 0)),
    ],
)
def test_pan_tilt_and_roll(angles: dict[str, float], forward: Any, right: Any) -> None:  # noqa: ANN401
    rotation = pose_of(turned(**angles))[:3, :3]
    np.testing.assert_allclose(rotation @ (0, 0, 1), forward, atol=1e-12)
    np.testing.assert_allclose(rotation @ (1, 0, 0), right, atol=1e-12)


def test_transforms_are_a_chain_and_the_pupil_is_in_front_of_the_sensor() -> None:
    dolly = {"translation": {"x": 10, "y": 0, "z": 0}, "rotation": {"pan": 90, "tilt": 0, "roll": 0}}
    values = sample(lens={"entrancePupilOffset": 0.125})
    values["transforms"].insert(0, dolly)
    np.testing.assert_allclose(pose_of(values)[:3, 3], (10 - 2 - 0.125, 1, 3))


def test_a_lens_is_opencvs() -> None:
    """Scaling by F^n, by the conversion that the standard's authors give."""
    camera = CameraModel(1920, 1080, np.array([[1000.0, 0, 0], [0, 1000, 0], [0, 0, 1]]))
    opencv = np.array([0.1, -0.02, 0.001, -0.002, 0.003, 0.01, 0.02, -0.004])
    k1, k2, p1, p2, k3, k4, k5, k6 = opencv
    focal = 24.0
    radial = [k1 / focal**2, k4 / focal**2, k2 / focal**4, k5 / focal**4, k3 / focal**6, k6 / focal**6]
    distortion = {
        "model": "Brown-Conrady U-D",
        "radial": radial,
        "tangential": [p1 / focal**2, p2 / focal**2],
    }
    lens = {
        "pinholeFocalLength": focal,
        "projectionOffset": {"x": 0.36, "y": -0.2},
        "distortion": [distortion],
    }
    static = {"camera": {"activeSensorPhysicalDimensions": {"width": 36.0, "height": 20.25}}}
    told = tracked_lens(Sample.model_validate(sample(lens=lens, static=static)), camera)
    assert told is not None
    scale = 1920 / 36
    wanted = [focal * scale, focal * scale, 959.5 + 0.36 * scale, 539.5 - 0.2 * scale]
    np.testing.assert_allclose(told.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], wanted)
    np.testing.assert_allclose(np.asarray(told.distortion), opencv)
    assert tracked_lens(Sample.model_validate(sample(lens=lens)), camera) is None
    distortion["model"] = "Brown-Conrady D-U"
    with pytest.raises(DeltalightError, match="must be given as Brown-Conrady U-D"):
        tracked_lens(Sample.model_validate(sample(lens=lens, static=static)), camera)


def cbor_of(value: Any) -> bytes:  # noqa: ANN401
    """A minimal encoder: 64-bit floats, lengths below 256."""
    match value:
        case dict():
            return bytes([0xB8, len(value)]) + b"".join(
                cbor_of(part) for pair in value.items() for part in pair
            )
        case list():
            return bytes([0x98, len(value)]) + b"".join(map(cbor_of, value))
        case str():
            return bytes([0x78, len(value)]) + value.encode()
        case _:
            return b"\xfb" + struct.pack(">d", value)


def test_cbor_is_read_as_json_is() -> None:
    """Examples of RFC 8949, appendix A."""
    read = {
        "00": 0,
        "1903e8": 1000,
        "3863": -100,
        "f93e00": 1.5,
        "fa47c35000": 100000.0,
        "f5": True,
        "f6": None,
    }
    for coded, value in read.items():
        assert decode_cbor(bytes.fromhex(coded)) == value
    assert decode_cbor(bytes.fromhex("a26161016162820203")) == {"a": 1, "b": [2, 3]}
    assert decode_cbor(bytes.fromhex("c11a514b67b0")) == 1363896240  # a tag
    for broken in ("", "19", "9affffffff", "bf", "62c328", "0000", "81" * 60 + "00", "a18001"):
        with pytest.raises(CborError):
            decode_cbor(bytes.fromhex(broken))


def test_samples_come_in_json_in_cbor_and_in_segments() -> None:
    reader, coded = PacketReader(), json.dumps(sample()).encode()
    assert reader.add(of_json(sample(), 1)) is not None
    assert reader.add(of_json(sample(), 1)) is None  # repeated
    assert reader.fault == ""
    assert reader.add(packet(cbor_of(sample()), 2, encoding=CBOR)) is not None
    parts = [coded[:40], coded[40:90], coded[90:]]
    offsets = [0, 40, 90]
    made = [
        packet(part, 65534 + number, offset=offset, flag=LAST if number == 2 else 0)
        for number, (part, offset) in enumerate(zip(parts, offsets, strict=True))
        if 65534 + number < 65536
    ]
    made.append(packet(parts[2], 0, offset=90))  # the count begins anew
    assert [reader.add(each) is not None for each in made] == [False, False, True]
    assert reader.add(made[0]) is None
    assert reader.add(made[2]) is None
    assert "was lost" in reader.fault


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"hello", "none of OpenTrackIO"),
        (of_json(sample())[:-1], "damaged"),
        (of_json(sample())[:-1] + b"]", "damaged"),
        (packet(b"{"), "no JSON"),
        (packet(b"[]"), "not an object"),
        (packet(b"{}", encoding=3), "coded as 0x03"),
        (packet(b"\xff", encoding=CBOR), "not CBOR"),
        (of_json(turned(pan=math.nan)), "pan"),
        (of_json(sample(transforms=[])), "transforms"),
        (of_json(sample(transforms=[{"translation": {"x": 1e9, "y": 0, "z": 0}}])), "transforms"),
    ],
)
def test_what_is_wrong_is_left_out_and_said(data: bytes, words: str) -> None:
    reader = PacketReader()
    assert reader.add(data) is None
    assert words in reader.fault
    assert "\n" not in reader.fault


@contextmanager
def sending(port: int) -> Iterator[socket.socket]:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as made:
        made.connect(("127.0.0.1", port))
        yield made


def test_a_node_takes_poses_and_lens_from_udp() -> None:
    """Real packets on loopback; the stage is turned and moved in the world."""
    stage = [[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    tracking = {"listen": "127.0.0.1", "port": 0, "world_from_stage": stage, "lens": True, "source_number": 7}
    config = NodeConfig.model_validate({"source": "synthetic", "tracking": tracking})
    camera = node_camera(config)
    assert isinstance(camera, TrackedCamera)
    lens = {"pinholeFocalLength": 6.0}
    static = {"camera": {"activeSensorPhysicalDimensions": {"width": 6.4, "height": 4.8}}}
    told = of_json(sample(sourceNumber=7, lens=lens, static=static))
    receiver = camera._tracker
    with receiver, sending(receiver.port) as out:
        out.send(told)
        assert receiver.with_lens(PATIENCE_S) is not None
        out.send(b"noise")
        out.send(of_json(sample(sourceNumber=8), 1))
        pose = receiver.at(time.time_ns())
    assert pose is not None
    np.testing.assert_allclose(pose[:3, 3], (0.5 - 2, 1, 3))
    np.testing.assert_allclose(pose[:3, 2], (-1, 0, 0), atol=1e-12)  # looks along the stage's y


def test_poses_are_interpolated_and_not_used_for_long() -> None:
    receiver = TrackingReceiver(TrackingSettings(delay_s=0.01))
    start_ns = 10**18
    for number in range(3):
        values = sample()
        values["transforms"][0]["translation"]["x"] = float(number)
        receiver._take(of_json(values, number), start_ns + number * 20_000_000)
    middle = receiver.at(start_ns - 10_000_000 + 30_000_000)
    assert middle is not None
    assert middle[0, 3] == pytest.approx(1.5)
    newest = receiver.at(start_ns + 100_000_000)
    assert newest is not None
    assert newest[0, 3] == 2.0
    assert receiver.at(start_ns + 200_000_000) is None
    assert receiver.at(start_ns - 200_000_000) is None
    assert "let it send OpenTrackIO" in receiver.remark(start_ns + 10**9)
    receiver._take(b"noise", start_ns)
    assert receiver.remark(start_ns + 10**9).endswith("send nothing else to this port.")
    assert receiver.remark(start_ns + 50_000_000) == ""


def test_a_silent_tracker_leaves_the_board() -> None:
    settings = TrackingSettings(listen="127.0.0.1", port=0)
    with TrackedCamera(SyntheticCamera(realtime=False), settings) as camera:
        assert camera.read().world_from_camera is None
        assert camera.board is not None
        state = camera.state
        assert state is not None
        assert (state.name, "no pose comes from the tracker" in state.detail) == ("stale", True)
        taken = TrackingSettings(listen="127.0.0.1", port=camera._tracker.port)
        with pytest.raises(DeltalightError, match="cannot be received at UDP port"), TrackingReceiver(taken):
            pass


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"listen": "somewhere"}, "somewhere"),
        ({"source_number": 201}, "200"),
        ({"world_from_stage": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "rigid"),
    ],
)
def test_wrong_settings_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        NodeConfig.model_validate({"tracking": values})
