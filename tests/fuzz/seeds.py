"""The inputs of each target: one small valid one of each kind, what covers most, and what failed once."""

import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import trimesh
import yaml
from mcap.reader import make_reader

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.codecs import encode_array, encode_color, encode_depth
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.radiance_files import write_exr
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.vectors import FOLDER, unframe_pieces
from deltalight.render_server.scene.material_file import write_material
from deltalight.render_server.scene.polynomial_texture import TERMS, PolynomialTexture
from deltalight.render_server.scene.texture_stack import LAYERS, TextureStack
from tests.fuzz.targets import RECORD_TOPICS, packed
from tests.render_server.brdf_samples import grey_brdf
from tests.render_server.gltf_samples import QUARTER_TURN, bent_bar
from tests.services.test_gltf_zip import PIECES, RED_PNG, gltf

CORPUS, KEPT = (Path(__file__).parent / name for name in ("corpus", "kept"))
_LONG = "long" * 800
SMALL = 6000  # bytes of a seed at most


def corpus(target: str) -> list[bytes]:
    """Returns the inputs that were found to cover most."""
    path = CORPUS / f"{target}.bin"
    return unframe_pieces(path.read_bytes()) if path.is_file() else []


def kept(target: str) -> list[bytes]:
    """Returns the inputs that failed once."""
    return [path.read_bytes() for path in sorted((KEPT / target).glob("*"))]


def seeds() -> Iterator[tuple[str, bytes]]:
    """Yields (target, input)."""
    for path in sorted(FOLDER.glob("*.bin")):
        if path.stat().st_size <= SMALL:
            yield "envelope", path.read_bytes()
    yield from _codecs()
    yield from _texts()
    with tempfile.TemporaryDirectory() as folder:
        yield from _recordings(Path(folder))
        yield from _meshes(Path(folder))
        yield from _maps(Path(folder))
        yield from _materials(Path(folder))
    yield from _archives()


def _codecs() -> Iterator[tuple[str, bytes]]:
    dice = np.random.default_rng(1)
    picture = cv2.resize(dice.integers(0, 255, (3, 4, 3), np.uint8), (32, 24))
    depth = np.linspace(0.3, 4, 24 * 32, dtype=np.float32).reshape(24, 32)
    yield "codecs", b"j" + encode_color(picture)
    yield "codecs", b"d" + encode_depth(depth, depth > 1, "blosc2", 0.001)
    yield "codecs", b"f" + encode_array(dice.random((8, 8, 3), np.float32), "blosc2")
    yield "codecs", b"b" + encode_array(np.zeros((8, 8), np.uint8), "blosc2")


def _texts() -> Iterator[tuple[str, bytes]]:
    document = {
        "name": "seed",
        "method": {"name": "dvct", "bounces": 1},
        "objects": [
            {"id": "a", "asset": "sha256:" + "0" * 64, "pose": {"translation_m": [0, 0, 1], "scale": 2.0}}
        ],
        "lights": {"mode": "manual", "manual": [{"type": "sphere", "position_m": [0, 0, 1]}]},
        "output": {"view": "composite"},
    }
    yield "scene", b"j" + json.dumps(document).encode()
    yield "scene", b"y" + yaml.safe_dump(document).encode()
    for wrong in (
        {"method": {"name": _LONG}},
        {_LONG: 1},
        {"lights": {"manual": [{"type": _LONG}]}},
        {"name": _LONG},
    ):
        yield "scene", b"j" + json.dumps(wrong).encode()
        yield (
            "camera",
            b"c" + yaml.safe_dump({**_camera().to_dict(), **wrong, "distortion_model": _LONG}).encode(),
        )
    yield "yaml", b"a: &x [1, 2.5e3, true, ~]\nb: {c: *x, <<: {d: 'e'}}\n"
    yield "yaml", b"a: &x\n  k: |\n    text\nb: {<<: *x}\n0x1f: 1:60\nd: 2001-12-14 21:59:43.10 -5\n"
    yield "lists", b"\0# time picture\n1.5 a.png 0.01\n1.6 a.png 0.02\n"
    yield "lists", b"\x011.5 a.png 0.01\n1.5 a.png 0.02\n"
    yield "lists", b"\x021.5 0.1 0.2 0.3 0 0 0 1\n2e0 0 0 0 0.5 0.5 0.5 0.5\n"
    yield "camera", b"c" + yaml.safe_dump(_camera().to_dict()).encode()
    rows = np.eye(4).tolist()
    yield "camera", b"x" + yaml.safe_dump({"depth_from_rgb": rows, "rgb_from_fisheye": rows}).encode()


def _camera() -> CameraModel:
    return CameraModel(16, 12, np.array([[14.0, 0, 7.5], [0, 14, 5.5], [0, 0, 1]]), "plumb_bob", np.zeros(5))


def _frames() -> list[SensorFrame]:
    depth = np.full((12, 16), 1.5, np.float32)
    return [
        SensorFrame(
            frame_id=index,
            timestamp_ns=1_000_000_000 + index * 100_000_000,
            color=np.full((12, 16, 3), 90 + index, np.uint8),
            camera=_camera(),
            depth=DepthImage(depth, depth > 0, _camera()),
            world_from_camera=np.eye(4),
        )
        for index in range(2)
    ]


def _recordings(folder: Path) -> Iterator[tuple[str, bytes]]:
    path = folder / "take.mcap"
    with RecordingWriter(path, depth_scale=0.001) as writer:
        for frame in _frames():
            writer.add(frame)
    yield "mcap", b"m" + path.read_bytes()
    with path.open("rb") as file:
        pieces = [
            bytes([RECORD_TOPICS.index(channel.topic), message.log_time % 251]) + message.data
            for _, channel, message in make_reader(file).iter_messages()
            if channel.topic in RECORD_TOPICS
        ]
    yield "mcap", b"p" + packed(pieces)


def _meshes(folder: Path) -> Iterator[tuple[str, bytes]]:
    yield "gltf", b"g" + bent_bar(folder, QUARTER_TURN).read_bytes()
    embedded = json.loads(gltf())
    del embedded["buffers"][0]["uri"]
    embedded["images"] = [{"bufferView": 3, "mimeType": "image/png"}]
    joined = b"".join(PIECES)
    embedded["bufferViews"].append({"buffer": 0, "byteOffset": len(joined), "byteLength": len(RED_PNG)})
    embedded["buffers"][0]["byteLength"] = len(joined + RED_PNG)
    yield "gltf", b"p" + packed([json.dumps(embedded).encode(), joined + RED_PNG])
    box = trimesh.creation.box((1, 1, 1))
    for number, kind in enumerate(("obj", "ply", "stl")):
        content = box.export(file_type=kind)
        yield "mesh", bytes([number]) + (content.encode() if isinstance(content, str) else content)
    yield "mesh", b"\x01" + box.export(file_type="ply", encoding="ascii")


def _maps(folder: Path) -> Iterator[tuple[str, bytes]]:
    light = np.linspace(0, 9, 4 * 8 * 3, dtype=np.float32).reshape(4, 8, 3)
    write_exr(folder / "map.exr", light)
    cv2.imwrite(str(folder / "map.hdr"), light)
    yield "radiance", b"e" + (folder / "map.exr").read_bytes()
    yield "radiance", b"h" + (folder / "map.hdr").read_bytes()


def _materials(folder: Path) -> Iterator[tuple[str, bytes]]:
    path, paint = folder / "paint.dlmat", grey_brdf(0.2, (0.1, 0.1, 0.5))
    texels = np.full((TERMS, 4, 6, 3), 0.1, np.float16)
    stack = TextureStack(np.full((LAYERS, 4, 6, 3), 0.1, np.float16), 0.04, 0.5)
    for material in (paint, PolynomialTexture(texels), stack):
        write_material(path, material)
        yield "material", b"f" + path.read_bytes()
        yield "material", b"a" + path.read_bytes().split(b"\n", 1)[1]


def _archives() -> Iterator[tuple[str, bytes]]:
    names = {
        "model/a.gltf": gltf(),
        "model/mesh data/quad.bin": b"".join(PIECES),
        "textures/red.png": RED_PNG,
    }
    for task, content in ((b"z", names), (b"d", _dataset())):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as made:
            for name, data in content.items():
                made.writestr(name, data)
        yield "archive", task + stream.getvalue()
        pieces = [each for name, data in content.items() for each in (name.encode(), data)]
        yield "archive", (b"Z" if task == b"z" else b"D") + packed(pieces)


def _dataset() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "take"
        with DatasetWriter(folder, depth_scale=0.001) as writer:
            for frame in _frames():
                writer.add(frame)
        return {
            str(path.relative_to(folder.parent)): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
