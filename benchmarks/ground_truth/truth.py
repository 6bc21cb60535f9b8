"""Truth of benchmark scenes, rendered once and cached by the hash of everything that determines it."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from rich.progress import Progress

from deltalight.benchmarks.ground_truth import fisheye
from deltalight.benchmarks.ground_truth.assembly import Assembly
from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene
from deltalight.benchmarks.ground_truth.content_hash import content_hash
from deltalight.benchmarks.ground_truth.document import document_path, scene_document
from deltalight.benchmarks.ground_truth.point_lamps import LENS_BLUR_PX, point_lamps
from deltalight.benchmarks.ground_truth.render import SUBPIXELS, choose_variant, integrators
from deltalight.benchmarks.ground_truth.sensors import ColorSensor, StereoDepthSensor
from deltalight.benchmarks.ground_truth.truth_pictures import Halves, TruthRenderer, coded_psnr
from deltalight.benchmarks.ground_truth.truth_writer import (
    TRUTH_FOLDER,
    is_whole,
    picture_path,
    write_truth,
)
from deltalight.protocol.cached_files import FOLDER_VARIABLE, cache_folder, cache_limit_bytes, prune
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.pictures import decode_rgb, read_bytes
from deltalight.protocol.scene import SceneDocument, load_scene

RENDER_VERSION = 2
"""Increment when rendering changes in a way that the hashed numbers do not show (seeds, samples of depth...)."""
CACHE = "ground-truth"


@dataclass(frozen=True, eq=False)
class TruthFrame:
    """One frame of truth; pictures are linear in camera units and noise-free unless stated otherwise.

    `without_halves` and `with_halves` are the room without and with virtual objects, each twice: half of the samples
    each, with seeds of their own. `cover` is the fraction of each pixel that virtual objects cover, 0..1. The
    `sensor` pictures are 8-bit sRGB with the same draw of camera noise.
    """

    without_halves: Halves
    with_halves: Halves
    cover: Float32[np.ndarray, "h w"]
    sensor_without: UInt8[np.ndarray, "h w 3"]
    sensor_with: UInt8[np.ndarray, "h w 3"]

    @cached_property
    def without(self) -> Float32[np.ndarray, "h w 3"]:
        """The room without objects, by all samples."""
        return np.asarray(self.without_halves.mean(axis=0))

    @cached_property
    def with_objects(self) -> Float32[np.ndarray, "h w 3"]:
        """The room with objects, by all samples."""
        return np.asarray(self.with_halves.mean(axis=0))

    @property
    def halves_psnr_db(self) -> float:
        """Agreement of the halves of `with_objects`; the mean is about 6 dB closer to what endless samples give."""
        return coded_psnr(*self.with_halves)


@dataclass(frozen=True)
class Truth:
    """A finished dataset folder (docs/formats.md 1) of the room without objects, and the truth beside it."""

    folder: Path
    scene: BenchmarkScene
    size: tuple[int, int]
    spp: int

    @property
    def frame_count(self) -> int:
        """Number of frames of the take."""
        return self.scene.frame_count

    def document(self, frame: int) -> SceneDocument:
        """Returns the scene document of a frame, with posed objects and absolute asset paths."""
        return load_scene(document_path(self.folder, self.scene, frame))

    def frame(self, frame: int) -> TruthFrame:
        """Reads the truth of a frame.

        Raises:
            DeltalightError: a picture is missing or damaged.
        """
        without, with_objects, cover = (self._picture(name, frame) for name in ("without", "with", "cover"))
        return TruthFrame(
            without_halves=without,
            with_halves=with_objects,
            cover=cover,
            sensor_without=self._sensor(self.folder / "rgb" / f"{frame:06d}.png"),
            sensor_with=self._sensor(self.folder / TRUTH_FOLDER / f"sensor_with-{frame:06d}.png"),
        )

    def _picture(self, name: str, frame: int) -> np.ndarray:
        path = picture_path(self.folder / TRUTH_FOLDER, name, frame)
        try:
            return np.asarray(np.load(path), np.float32)
        except (OSError, ValueError) as error:
            raise DeltalightError(
                f"{path} cannot be read; remove {self.folder} to have it rendered again."
            ) from error

    def _sensor(self, path: Path) -> UInt8[np.ndarray, "h w 3"]:
        return decode_rgb(read_bytes(path), str(path))


def ensure_truth(
    scene: BenchmarkScene, *, size: tuple[int, int], spp: int, progress: Progress, cache: Path | None = None
) -> Truth:
    """Returns the truth of a scene, rendering it if `cache` (default: that of the user) does not hold it whole.

    `size` is width and height in pixels, `spp` the samples per pixel of each picture. The folder appears when it is
    complete; an interrupted run leaves nothing. What was not used for longest gives way beyond the cache's limit.

    Raises:
        DeltalightError: Mitsuba is missing, or size or spp cannot be rendered.
    """
    least = 2 * SUBPIXELS**2
    if spp < least or spp % least:
        raise DeltalightError(f"{spp} samples a pixel cannot be halved evenly; give a multiple of {least}.")
    variant = choose_variant()
    camera, cache = scene.camera.resized(*size), cache or cache_folder(CACHE)
    with _workshop(cache) as workshop:
        assembly = Assembly(scene, workshop)
        about = _about(scene, size, spp, variant)
        digest = content_hash(about, *_determining(assembly, camera))
        truth = Truth(cache / f"{scene.name}-{size[0]}x{size[1]}-{digest}", scene, size, spp)
        if not is_whole(truth.folder):
            _render(truth, assembly, camera, about, progress)
    prune(cache, cache_limit_bytes(), keep=truth.folder)
    return truth


@contextmanager
def _workshop(cache: Path) -> Iterator[Path]:
    """Yields a temporary folder beside the finished ones."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        workshop = tempfile.TemporaryDirectory(dir=cache, prefix=".making-")
    except OSError as error:
        raise DeltalightError(
            f"ground truth cannot be kept in {cache} ({error.strerror}); set {FOLDER_VARIABLE} to a folder."
        ) from error
    with workshop as folder:
        yield Path(folder)


def _about(scene: BenchmarkScene, size: tuple[int, int], spp: int, variant: str) -> dict[str, Any]:
    import mitsuba as mi

    return {
        "scene": scene.name,
        "size": list(size),
        "spp": spp,
        "mitsuba": mi.__version__,
        "variant": variant,
        "render_version": RENDER_VERSION,
    }


def _determining(assembly: Assembly, camera: CameraModel) -> list[object]:
    """Returns everything else that determines the folder's content."""
    scene = assembly.scene
    poses = [scene.world_from_camera, *(item.world_from_object for item in scene.objects)]
    documents = [scene_document(scene, 0), scene.board.model_dump(mode="json")]
    lenses = [camera.to_dict(), fisheye.CAMERA.to_dict(), fisheye.EXPOSURES_S]
    sensors = [repr(ColorSensor()), repr(StereoDepthSensor())]
    blur = [LENS_BLUR_PX] if point_lamps(scene.lamps) else []
    traced = integrators(scene.max_depth)
    return [assembly.with_objects(0), poses, documents, lenses, sensors, traced, *blur]


def _render(
    truth: Truth, assembly: Assembly, camera: CameraModel, about: dict[str, Any], progress: Progress
) -> None:
    task = progress.add_task(f"rendering truth of {truth.scene.name}")
    renderer = TruthRenderer(assembly, camera, truth.spp, lambda: progress.advance(task))
    progress.update(task, total=renderer.step_count)
    made = assembly.folder / truth.folder.name
    write_truth(made, renderer, about)
    try:
        shutil.rmtree(truth.folder, ignore_errors=True)  # a damaged one
        made.rename(truth.folder)
    except OSError:
        # Another process may have finished the same truth meanwhile.
        if not truth.folder.is_dir():
            raise
