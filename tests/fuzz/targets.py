"""What is fuzzed: the decoder of each format that comes from outside, as a function of bytes.

A target may refuse its input in one sentence (`DeltalightError`, or `ValueError` where the decoder promises that).
Whatever else it raises is a fault. Formats of several parts take them from the bytes, so that mutations reach what
lengths and checksums would keep them from.
"""

import io
import struct
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.codecs import decode_array, decode_color, decode_depth, decode_response, jpeg_size
from deltalight.protocol.dataset_lists import read_fisheye_list, read_list, read_poses
from deltalight.protocol.documents import parse_mapping
from deltalight.protocol.envelope import EnvelopeError, decode, encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.light_codecs import fisheye_pictures, lamp_poses, radiance_map, sky_lights
from deltalight.protocol.messages import (
    ColorMessage,
    ControlRequest,
    DepthMessage,
    FisheyeMessage,
    LampsMessage,
    LightsMessage,
    RadianceMessage,
)
from deltalight.protocol.payloads import decode_control
from deltalight.protocol.radiance_files import read_linear
from deltalight.protocol.recording_format import (
    COLOR_TOPIC,
    DEPTH_TOPIC,
    FRAME_TOPIC,
    POSE_TOPIC,
    SESSION_TOPIC,
)
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.yaml_text import parse_yaml, yaml_text
from deltalight.render_server.scene import asset_check, mesh_loading  # noqa: F401 - before atheris looks away
from deltalight.services.recording_info import describe_recording
from deltalight.services.storage.asset_facts import map_facts, material_facts, mesh_facts
from deltalight.services.storage.gltf_zip import repack
from deltalight.services.storage.recording_check import check_recording

LONGEST_SENTENCE = 2000
MOST_PIECES = 40
UNPACKED_BYTES = 1 << 20
MESHES = (".obj", ".ply", ".stl")
RECORD_TOPICS = (SESSION_TOPIC, FRAME_TOPIC, COLOR_TOPIC, DEPTH_TOPIC, POSE_TOPIC)
_WORKSHOP = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())


def packed(pieces: Sequence[bytes]) -> bytes:
    """Returns the pieces as one input."""
    return b"".join(struct.pack("<I", len(piece)) + piece for piece in pieces)


def pieces_of(data: bytes) -> list[bytes]:
    """Returns the pieces of an input; the last takes what is left."""
    pieces: list[bytes] = []
    place = 0
    while place + 4 <= len(data) and len(pieces) < MOST_PIECES:
        (length,) = struct.unpack_from("<I", data, place)
        pieces.append(data[place + 4 : place + 4 + length])
        place += 4 + length
    return pieces


def envelope(data: bytes) -> None:
    """A multipart of the wire, and what its receiver makes of it."""
    pieces = pieces_of(data)
    message, parts = decode(pieces)
    if decode(encode(message, parts)) != (message, parts):
        raise AssertionError("a message does not come back as it was sent")
    match message:
        case ColorMessage():
            decode_color(parts[0], message.encoding, message.shape)
            CameraModel.from_dict(message.camera)
            if message.has_response:
                decode_response(parts[-1])
        case DepthMessage():
            decode_depth(parts[0], message.encoding, message.shape, message.depth_scale_m)
            CameraModel.from_dict(message.camera)
        case FisheyeMessage():
            fisheye_pictures(message, parts)
        case RadianceMessage():
            radiance_map(message, parts)
        case LightsMessage():
            sky_lights(message, parts)
        case LampsMessage():
            lamp_poses(message)
        case ControlRequest():
            decode_control(pieces, ControlRequest)


def codecs(data: bytes) -> None:
    """A coded part: a picture, or an array of one of three kinds."""
    kind, part = data[:1], data[1:]
    if kind == b"j":
        height, width = jpeg_size(part)
        if height * width <= 1 << 20:
            decode_color(part, "jpeg", (height, width, 3))
    elif kind == b"f":
        decode_array(part, "blosc2", (8, 8, 3), "float32")
    elif kind == b"b":
        decode_array(part, "blosc2", (8, 8), "uint8")
    else:
        decode_depth(part, "blosc2", (24, 32), 0.001)


def scene(data: bytes) -> None:
    """A scene document, as JSON or YAML."""
    text = data[1:].decode("utf-8", errors="replace")
    document = parse_scene(parse_mapping(text, "the scene", is_json=data[:1] != b"y"))
    if parse_scene(document.model_dump(mode="json")) != document:
        raise AssertionError("a scene does not come back as it was written")


def yaml(data: bytes) -> None:
    """A YAML document."""
    found = parse_yaml(data.decode("utf-8", errors="replace"))
    if isinstance(found, dict) and all(isinstance(key, str) for key in found):
        yaml_text(found)


def lists(data: bytes) -> None:
    """A list file of one of three kinds, beside a file `a.png`."""
    with tempfile.TemporaryDirectory(dir=_WORKSHOP) as folder:
        path = Path(folder) / "list.txt"
        path.with_name("a.png").touch()
        path.write_bytes(data[1:])
        (read_list, read_fisheye_list, read_poses)[(data[:1] or b"\0")[0] % 3](path)


def camera(data: bytes) -> None:
    """A description of a camera or of transforms, as YAML."""
    found = parse_mapping(data[1:].decode("utf-8", errors="replace"), "the camera", is_json=False)
    if data[:1] == b"x":
        Extrinsics.from_dict(found, "the camera")
    else:
        CameraModel.from_dict(found)


def mcap(data: bytes) -> None:
    """A recording: the file itself, or one with the given messages."""
    is_file = data[:1] == b"m"
    _on_file(data[1:] if is_file else _recording(pieces_of(data[1:])), ".mcap", _read_recording)


def gltf(data: bytes) -> None:
    """A .glb: the file itself, or one of the given JSON and binary chunk."""
    content = data[1:] if data[:1] == b"g" else _glb(pieces_of(data[1:]))
    _on_file(content, ".glb", mesh_facts)


def mesh(data: bytes) -> None:
    """A mesh file of another format."""
    _on_file(data[1:], MESHES[(data[:1] or b"\0")[0] % len(MESHES)], mesh_facts)


def radiance(data: bytes) -> None:
    """A .hdr or .exr picture."""
    _on_file(data[1:], ".exr" if data[:1] == b"e" else ".hdr", _read_map)


def material(data: bytes) -> None:
    """A precomputed material: the file itself, or its archive under the right hash."""
    arrays = data[1:]
    head = (
        b"" if data[:1] == b"f" else b"deltalight material 1 " + sha256(arrays).hexdigest().encode() + b"\n"
    )
    _on_file(head + arrays, ".dlmat", material_facts)


def archive(data: bytes) -> None:
    """An uploaded .zip, of a glTF or a dataset folder: the file itself, or one of the given names and contents."""
    task = repack if data[:1] in (b"z", b"Z") else check_recording
    content = data[1:] if data[:1] in (b"z", b"d") else _zip(pieces_of(data[1:]))
    _on_file(content, ".zip", lambda path: task(path, str(path.with_name("out.mcap")), str(UNPACKED_BYTES)))


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target
    for target in (
        envelope,
        codecs,
        scene,
        yaml,
        lists,
        camera,
        mcap,
        gltf,
        mesh,
        radiance,
        material,
        archive,
    )
}
"""By name."""


def attempt(target: str, data: bytes) -> bool:
    """Runs a target; returns whether it took the input.

    Raises:
        Exception: what the target must not raise, or a refusal of more than 2000 characters.
    """
    try:
        TARGETS[target](data)
    except (DeltalightError, EnvelopeError) as refusal:
        _require_sentence(str(refusal))
        return False
    except ValueError as refusal:
        if target != "yaml" or type(refusal) is not ValueError:
            raise
        return False
    return True


def _require_sentence(text: str) -> None:
    if not 0 < len(text) <= LONGEST_SENTENCE:
        raise AssertionError(f"a refusal of {len(text)} characters")


def _on_file(content: bytes, suffix: str, read: Callable[[Path], object]) -> None:
    with tempfile.TemporaryDirectory(dir=_WORKSHOP) as folder:
        path = Path(folder) / f"input{suffix}"
        path.write_bytes(content)
        read(path)


def _read_recording(path: Path) -> None:
    describe_recording(path)
    reader = RecordingReader(path)
    for index in range(min(len(reader), 3)):
        _ = reader[index]


def _read_map(path: Path) -> None:
    map_facts(path)
    if not np.isfinite(read_linear(path)).all():
        raise AssertionError("a map that is not finite")


def _recording(pieces: Sequence[bytes]) -> bytes:
    """Returns a finished recording; the first byte of a piece chooses its topic, the second its time."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("x", "", b"")
    channels = [writer.register_channel(topic, "", schema) for topic in RECORD_TOPICS]
    for piece in pieces:
        if len(piece) >= 2:
            writer.add_message(channels[piece[0] % len(channels)], piece[1], piece[2:], piece[1])
    writer.finish()
    return stream.getvalue()


def _glb(pieces: Sequence[bytes]) -> bytes:
    text, binary, *_ = [*pieces, b"", b""]
    chunks = _chunk(0x4E4F534A, text + b" " * (-len(text) % 4)) + _chunk(
        0x004E4942, binary + bytes(-len(binary) % 4)
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _chunk(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", len(data), kind) + data


def _zip(pieces: Sequence[bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as made:
        for name, content in zip(pieces[::2], pieces[1::2], strict=False):
            made.writestr(name.decode("latin-1").replace("\0", "") or "x", content)
    return stream.getvalue()
