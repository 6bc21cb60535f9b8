"""A bin seen by two fixed cameras, empty and with things in it: real things before virtual ones, and no harm.

Occlusion: a virtual sheet lies on the bin's floor, beneath the real things. Their pixels must stay the camera's,
those of the bare floor must show the sheet. No harm: the things are put into the picture of the empty bin as cuboids
under even light; the floor must come no farther from the photograph with them than it is without.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64
from rich.progress import Progress

from deltalight.benchmarks.ground_truth.sensors import srgb_bytes
from deltalight.benchmarks.quality.metrics import Mask, Picture
from deltalight.benchmarks.quality.regions import Linear
from deltalight.benchmarks.real.cuboid import Cuboid, rough_cuboid
from deltalight.benchmarks.real.light_fit import FoundLights
from deltalight.benchmarks.real.pictures import linear, read_color, read_values
from deltalight.benchmarks.real.ranges import Plane, Values, fit_plane
from deltalight.benchmarks.real.relit import WHITE, table_frame, table_scene
from deltalight.benchmarks.real.score import psnr_db
from deltalight.benchmarks.real.things import standing, table_mask
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.relighting import RelitPicture, Renderer

FOLDER = "robot_bins"
CAMERAS = (0, 1)
SIZE, DEPTH_STEP_M = (640, 480), 1e-4
MIDDLE = (0.3, 0.7)
"""Part of the picture, in rows and columns, that shows the bin's floor."""
DIFFERENT_CODES = 40
"""By how many codes a channel differs from the empty bin's, equally exposed, where a thing is."""
RIM_PX, NEAR_PX = 5, 40
SHEET_M, SHEET_THICKNESS_M = 0.008, 0.001
"""Place of the sheet over the floor: above its ribs, below the things."""
EVEN = FoundLights((), np.ones(3), 0.0)


@dataclass(frozen=True, eq=False)
class BinResult:
    """Figures of one camera, and pictures for people who look.

    `kept`: fraction of the things' pixels that stay the camera's over the sheet; `covered`: of the bare floor's that
    show it. PSNR of the floor near the things, dB, without relighting and with it.
    """

    camera: int
    kept: float
    covered: float
    none_psnr_db: float
    exact_psnr_db: float
    sheet: Picture
    relit: Picture
    truth: Picture


def measure_bins(folder: Path, progress: Progress, device: int | None) -> list[BinResult]:
    """Measures both cameras.

    Raises:
        DeltalightError: a file is missing or wrong, or shows no bin.
    """
    bins = [_Bin.read(folder, camera) for camera in CAMERAS]
    with (
        Renderer("none", "best", device=device) as drawing,
        Renderer("exact", "best", device=device) as relighting,
    ):
        return [
            each.measured(drawing, relighting)
            for each in progress.track(bins, description=f"{FOLDER}: rendering")
        ]


@dataclass(frozen=True, eq=False)
class _Bin:
    """One camera's pictures; `truth` is linear, exposed as the empty bin's; depth along the optical axis, m."""

    camera: int
    empty: Picture
    truth: Linear
    depth_m: Values
    plane: Plane
    floor: Mask
    things: Mask

    @classmethod
    def read(cls, folder: Path, camera: int) -> "_Bin":
        lens = _camera_model(folder / f"camera-{camera}.intrinsics.txt")
        empty, full = (
            read_color(folder / f"{what}-{camera}.color.png", SIZE) for what in ("background", "input")
        )
        empty_m, full_m = (
            DEPTH_STEP_M * read_values(folder / f"{what}-{camera}.depth.png", SIZE)
            for what in ("background", "input")
        )
        plane = fit_plane(lens, _ranges(lens, empty_m), _middle(), at_camera=True)
        floor = table_mask(np.where(empty_m > 0, plane.points(empty_m)[..., 2], np.inf))
        exposure = np.median((linear(full) / np.maximum(linear(empty), 1e-3))[floor], axis=0)
        truth = np.asarray(linear(full) / exposure, np.float32)
        difference = np.abs(srgb_bytes(truth).astype(int) - empty).max(axis=2)
        differs = (floor & (difference > DIFFERENT_CODES)).astype(np.uint8)
        things = cv2.morphologyEx(differs, cv2.MORPH_OPEN, np.ones((3, 3))) > 0
        return cls(camera, empty, truth, full_m, plane, floor, things)

    def measured(self, drawing: Renderer, relighting: Renderer) -> BinResult:
        with tempfile.TemporaryDirectory() as folder:
            sheet = self._with_sheet(drawing, Path(folder))
        with tempfile.TemporaryDirectory() as folder:
            relit = self._with_cuboids(relighting, Path(folder))
        bare = self.floor & ~_grown(self.things, RIM_PX)
        on_sheet = self._sheet_outline()
        near = bare & _grown(self.things, NEAR_PX) & ~_grown(relit.coverage > 0, RIM_PX)
        return BinResult(
            self.camera,
            kept=float((sheet.coverage[self.things & on_sheet] < 0.5).mean()),
            covered=float((sheet.coverage[bare & on_sheet] > 0.5).mean()),
            none_psnr_db=psnr_db(linear(self.empty), self.truth, near),
            exact_psnr_db=psnr_db(relit.linear, self.truth, near),
            sheet=sheet.color,
            relit=relit.color,
            truth=srgb_bytes(self.truth),
        )

    def _with_sheet(self, renderer: Renderer, folder: Path) -> RelitPicture:
        """Returns the photograph of the things with a sheet beneath them."""
        depth = np.asarray(self.depth_m, np.float32)
        pose = BoardPose(self.plane.world_from_camera)
        image = DepthImage(depth, depth > 0, self.plane.camera)
        frame = ViewFrame(self.camera, 1, srgb_bytes(self.truth), self.plane.camera, pose=pose, depth=image)
        scene = table_scene([(self._sheet(), np.full(3, WHITE))], EVEN, self._bare(), folder)
        scene.move("cuboid0", (0, 0, SHEET_M))
        renderer.forget()
        return renderer.render(frame, scene)

    def _with_cuboids(self, renderer: Renderer, folder: Path) -> RelitPicture:
        """Returns the photograph of the empty bin with cuboids for the things."""
        points, bare = self.plane.points(self.depth_m), self._bare()
        heights = np.where(self.depth_m > 0, points[..., 2], -1)
        inside = [mask & self.floor for mask in standing(np.where(self.floor, heights, -1))]
        albedo = [WHITE * self.truth[mask].mean(axis=0) / bare for mask in inside]
        things = list(zip([rough_cuboid(points[mask]) for mask in inside], albedo, strict=True))
        if not things:
            raise DeltalightError(
                f"depth of camera {self.camera} shows nothing in the bin; copy {FOLDER} again."
            )
        renderer.forget()
        frame = table_frame(self.camera, self.empty, self.plane, self.floor)
        return renderer.render(frame, table_scene(things, EVEN, bare, folder))

    def _bare(self) -> Float64[np.ndarray, " 3"]:
        return np.asarray(np.median(linear(self.empty)[self.floor], axis=0), np.float64)

    def _sheet(self) -> Cuboid:
        points = self.plane.points(self.plane.depth_m)[self.floor]
        (left, front), (right, back) = np.percentile(points[:, :2], (10, 90), axis=0)
        size = (float(right - left), float(back - front), SHEET_THICKNESS_M)
        return Cuboid(float(left + right) / 2, float(front + back) / 2, 0.0, size)

    def _sheet_outline(self) -> Mask:
        """Returns the pixels of the floor under the sheet."""
        points, sheet = self.plane.points(self.plane.depth_m), self._sheet()
        half = np.array(sheet.size_m[:2]) / 2 - SHEET_M
        return np.asarray(self.floor & (np.abs(points[..., :2] - (sheet.x_m, sheet.y_m)) < half).all(axis=2))


def _camera_model(path: Path) -> CameraModel:
    try:
        matrix = np.loadtxt(path)
    except (OSError, ValueError) as fault:
        raise DeltalightError(
            f"{path} must hold a camera matrix of 3x3 numbers; copy {FOLDER} again."
        ) from fault
    return CameraModel(*SIZE, matrix)


def _ranges(camera: CameraModel, depth_m: Values) -> Values:
    rays = camera.rays().astype(np.float64)
    return np.asarray(depth_m * np.sqrt(1 + (rays**2).sum(axis=2)))


def _middle() -> Mask:
    width, height = SIZE
    middle = np.zeros((height, width), bool)
    rows, columns = ([int(edge * part) for part in MIDDLE] for edge in (height, width))
    middle[slice(*rows), slice(*columns)] = True
    return middle


def _grown(mask: Mask, reach_px: int) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach_px + 1,) * 2)) > 0)


def row_of_pictures(results: Sequence[BinResult]) -> Picture:
    """Returns sheet, relit bin and photograph of every camera, one row each."""
    return np.vstack([np.hstack([each.sheet, each.relit, each.truth]) for each in results])
