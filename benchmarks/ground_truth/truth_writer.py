"""Writing a benchmark scene's truth: the dataset folder of simulated sensors, and the reference pictures."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.document import write_documents
from deltalight.benchmarks.ground_truth.fisheye import write_bracket
from deltalight.benchmarks.ground_truth.sensors import ColorSensor, StereoDepthSensor
from deltalight.benchmarks.ground_truth.truth_pictures import (
    SEED,
    FramePictures,
    TruthRenderer,
    world_from_fisheye,
)
from deltalight.protocol.cached_files import mark_used
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.pictures import depth_from_steps, encode_png

TRUTH_FOLDER = "truth"
MANIFEST_FILE = "manifest.json"
FRAME_RATE_HZ = 15
FIRST_CAPTURE_NS = 1_000_000_000


def write_truth(out: Path, renderer: TruthRenderer, about: dict[str, Any]) -> None:
    """Renders everything and writes it into the folder `out`; `about` goes into the manifest."""
    scene = renderer.assembly.scene
    extrinsics = Extrinsics(world_from_fisheye=world_from_fisheye(renderer.assembly))
    step_m = StereoDepthSensor().step_m
    with DatasetWriter(out, board=scene.board, extrinsics=extrinsics, depth_scale=step_m) as dataset:
        (out / TRUTH_FOLDER).mkdir()
        for index in range(scene.frame_count):
            pictures = renderer.frame(index)
            frame = sensor_frame(index, pictures, renderer.camera)
            dataset.add(replace(frame, world_from_camera=scene.world_from_camera[index]))
            _write_pictures(out / TRUTH_FOLDER, index, pictures)
        write_bracket(out, renderer.fisheye(), FIRST_CAPTURE_NS, np.random.default_rng(SEED))
    write_documents(out, scene)
    for asset in renderer.assembly.assets.iterdir():
        shutil.copy(asset, out)
    manifest = {**about, "files": _hashes(out)}
    (out / TRUTH_FOLDER / MANIFEST_FILE).write_text(json.dumps(manifest, indent=2) + "\n")


def is_whole(folder: Path) -> bool:
    """Whether a truth is there and its files are what was written; marks it as used."""
    try:
        manifest = json.loads((folder / TRUTH_FOLDER / MANIFEST_FILE).read_text())
        files: dict[str, str] = manifest.get("files", {})  # an older truth has none
        is_same = files == {name: _hash(folder / name) for name in files}
    except (OSError, ValueError, AttributeError):
        return False
    mark_used(folder)
    return is_same


def _hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): _hash(path) for path in sorted(folder.rglob("*")) if path.is_file()
    }


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def sensor_frame(index: int, pictures: FramePictures, camera: CameraModel) -> SensorFrame:
    """Returns the room as the sensors deliver it, without a pose."""
    stereo = depth_sensor(camera)
    steps = stereo.measure(pictures.depth_m, np.random.default_rng([SEED, index, 1]))
    capture_ns = FIRST_CAPTURE_NS + round(index * 1e9 / FRAME_RATE_HZ)
    return SensorFrame(
        frame_id=index,
        timestamp_ns=capture_ns,
        color=_exposed(pictures.without.mean(axis=0), index),
        camera=camera,
        depth=depth_from_steps(steps, stereo.step_m, camera, stereo.sigma_at_1m),
        depth_timestamp_ns=capture_ns,
    )


def depth_sensor(camera: CameraModel) -> StereoDepthSensor:
    """Returns the depth sensor behind a camera of any size, which measures surfaces up to the same slant."""
    whole, focal_px = StereoDepthSensor(), float(camera.matrix[0, 0])
    return replace(whole, focal_px=focal_px, edge_step=whole.edge_step * whole.focal_px / focal_px)


def _exposed(color: Float32[np.ndarray, "h w 3"], index: int) -> np.ndarray:
    """Returns the picture of frame `index` with that frame's draw of noise, the same for without and with."""
    return ColorSensor().expose(color, np.random.default_rng([SEED, index]))


def _write_pictures(folder: Path, index: int, pictures: FramePictures) -> None:
    """Writes linear pictures in half precision, which is far finer than noise and 8-bit code."""
    named = {"without": pictures.without, "with": pictures.with_objects, "cover": pictures.cover}
    for name, picture in named.items():
        np.save(picture_path(folder, name, index), picture.astype(np.float16))
    sensor = encode_png(_exposed(pictures.with_objects.mean(axis=0), index))
    (folder / f"sensor_with-{index:06d}.png").write_bytes(sensor)


def picture_path(folder: Path, name: str, index: int) -> Path:
    """Returns the path of the linear picture `name` (without, with, cover) of a frame."""
    return folder / f"{name}-{index:06d}.npy"
