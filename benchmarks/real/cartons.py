"""Cartons on a white table: lights found in one photograph, shadows compared in the others."""

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
from deltalight.benchmarks.real.blob import Blob, fit_blob
from deltalight.benchmarks.real.cuboid import Cuboid, fit_cuboid, outline
from deltalight.benchmarks.real.light_fit import FoundLights, fit_lights
from deltalight.benchmarks.real.pictures import linear, read_color, read_values
from deltalight.benchmarks.real.ranges import Plane, fit_plane
from deltalight.benchmarks.real.relit import WHITE, table_frame, table_scene
from deltalight.benchmarks.real.score import Figures, changed_part, score
from deltalight.benchmarks.real.things import find_thing
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.relighting import Renderer

FOLDER = "carton_table"
SIZE, FOCAL_PX = (640, 480), 525.0
"""Of the range camera's maker: with it, and with no other focal length, the ranges of the table fit a plane."""
PLATE = "plate_*.png"
TABLE_ROWS = 0.4
"""The table lies below this fraction of the picture; above is what stands behind it."""
RIM_PX = 5
"""Colour bleeds so far over a thing's edge."""
NEAR_HEIGHTS, FAR_HEIGHTS = 3.0, 1.5
"""Heights of the thing within which shadows are fitted, and beyond which the table tells the exposure."""
SMOOTH_PX, MOST_POINTS = 9, 3000


@dataclass(frozen=True, eq=False)
class Photograph:
    """A carton on the table: linear, exposed as the empty table; `table` leaves out the carton."""

    name: str
    cuboid: Cuboid
    agreement: float
    truth: Linear
    thing: Mask
    table: Mask
    changed: Mask


@dataclass(frozen=True, eq=False)
class Shown:
    """Pictures of one photograph by each way, 8-bit, for people who look."""

    name: str
    fit: Picture
    truth: Picture
    results: dict[str, Picture]


@dataclass(frozen=True, eq=False)
class CartonResult:
    """What was fitted in the first photograph, and the figures of all: by photograph, then by way."""

    plane: Plane
    lights: FoundLights
    cuboids: dict[str, Cuboid]
    agreement: dict[str, float]
    figures: dict[str, dict[str, Figures]]
    shown: Sequence[Shown]


def measure_cartons(folder: Path, progress: Progress, device: int | None) -> CartonResult:
    """Fits lights in the first photograph of a folder and compares all.

    Raises:
        DeltalightError: a file is missing or wrong, or shows no table or nothing on it.
    """
    table = _Table.read(folder)
    names = _names(folder)
    photographs = [
        table.photograph(name) for name in progress.track(names, description=f"{FOLDER}: cartons are fitted")
    ]
    with Renderer("exact", "best", device=device) as renderer:
        task = progress.add_task(f"{FOLDER}: lights are found in {names[0]}", total=None)
        lights, blob = table.found(photographs[0], renderer)
        progress.update(task, total=1, completed=1)
        done = progress.track(photographs, description=f"{FOLDER}: relighting")
        results = {photograph.name: table.results(photograph, lights, blob, renderer) for photograph in done}
    return CartonResult(
        table.plane,
        lights,
        {each.name: each.cuboid for each in photographs},
        {each.name: each.agreement for each in photographs},
        {each.name: table.figures(each, results[each.name]) for each in photographs},
        [table.shown(each, results[each.name]) for each in photographs],
    )


def _names(folder: Path) -> list[str]:
    names = sorted(path.name.removesuffix("r.png") for path in folder.glob("pcd*r.png"))
    if len(names) < 2:
        raise DeltalightError(f"{folder} must hold two photographs pcd*r.png or more; copy it again.")
    return names


@dataclass(frozen=True, eq=False)
class _Table:
    """The empty table: its photograph, plane and points."""

    folder: Path
    codes: Picture
    plate: Linear
    plane: Plane
    points: Float64[np.ndarray, "h w 3"]

    @classmethod
    def read(cls, folder: Path) -> "_Table":
        plates = sorted(folder.glob(PLATE))
        codes = read_color(plates[0] if plates else folder / PLATE, SIZE)
        ranges = read_values(folder / f"{_names(folder)[0]}d.tiff", SIZE)
        width, height = SIZE
        matrix = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])
        below = np.zeros(ranges.shape, bool)
        below[int(TABLE_ROWS * height) :] = True
        plane = fit_plane(CameraModel(width, height, matrix), ranges, below, at_camera=False)
        return cls(folder, codes, linear(codes), plane, plane.points(plane.depth_m))

    def photograph(self, name: str) -> Photograph:
        codes = read_color(self.folder / f"{name}r.png", SIZE)
        ranges = read_values(self.folder / f"{name}d.tiff", SIZE)
        picture, plane = linear(codes), self.plane
        ratio = picture / np.maximum(self.plate, 1e-3)
        thing = find_thing(codes, ratio, plane.points(plane.depth_of_ranges(ranges)))
        cuboid = fit_cuboid(thing.observed, plane)
        seen, drawn = thing.observed.mask, outline(cuboid, plane)
        covered = cv2.dilate((seen | drawn).astype(np.uint8), np.ones((2 * RIM_PX + 1,) * 2)) > 0
        table = thing.table & ~covered
        exposure = np.median(ratio[table & ~self._near(cuboid, FAR_HEIGHTS)], axis=0)
        truth = np.asarray(picture / exposure, np.float32)
        agreement = float(np.count_nonzero(seen & drawn) / np.count_nonzero(seen | drawn))
        changed = changed_part(truth, self.plate, table)
        return Photograph(name, cuboid, agreement, truth, seen, table, changed)

    def _near(self, cuboid: Cuboid, heights: float) -> Mask:
        away = np.hypot(self.points[..., 0] - cuboid.x_m, self.points[..., 1] - cuboid.y_m)
        return np.asarray(away < heights * cuboid.size_m[2])

    def found(self, photograph: Photograph, renderer: Renderer) -> tuple[FoundLights, Blob]:
        """Returns lights and blob that explain a photograph.

        Lights are found twice: what the carton sends back, which closed forms leave out, is known from a picture that
        is relit by the first ones, and taken out of the photograph for the second.
        """
        ratios = _smooth_ratios(photograph.truth, self.plate, photograph.table)
        places = np.flatnonzero(photograph.table & self._near(photograph.cuboid, NEAR_HEIGHTS))
        places = places[:: max(1, len(places) // MOST_POINTS)]
        points, kept = self.points.reshape(-1, 3)[places], ratios.reshape(-1, 3)[places].astype(np.float64)
        cuboid = photograph.cuboid
        first = fit_lights(points, kept, cuboid)
        relit = _smooth_ratios(self._relit(photograph, first, renderer), self.plate, photograph.table)
        sent_back = relit.reshape(-1, 3)[places] - first.ratios(points, cuboid)
        return fit_lights(points, kept - sent_back, cuboid), fit_blob(points, kept, cuboid)

    def results(
        self, photograph: Photograph, lights: FoundLights, blob: Blob, renderer: Renderer
    ) -> dict[str, Linear]:
        """Returns the table by each way, linear: as it was, with a blob, with closed-form shadows, relit."""
        pairs = {"none": self.plate}
        for way, shadow in (("blob", blob), ("closed form", lights)):
            pairs[way] = self.plate.copy()
            pairs[way][photograph.table] *= shadow.ratios(self.points[photograph.table], photograph.cuboid)
        return {**pairs, "exact": self._relit(photograph, lights, renderer)}

    def _relit(self, photograph: Photograph, lights: FoundLights, renderer: Renderer) -> Linear:
        bare = np.median(self.plate[photograph.table], axis=0)
        albedo = WHITE * photograph.truth[photograph.thing].mean(axis=0) / bare
        under = cv2.morphologyEx(photograph.table.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3)))
        under[outline(photograph.cuboid, self.plane) | photograph.thing] = 1
        renderer.forget()
        frame = table_frame(0, self.codes, self.plane, _filled(under))
        with tempfile.TemporaryDirectory() as folder:
            scene = table_scene([(photograph.cuboid, albedo)], lights, bare, Path(folder))
            return renderer.render(frame, scene).linear

    def figures(self, photograph: Photograph, results: dict[str, Linear]) -> dict[str, Figures]:
        truth, table, changed = photograph.truth, photograph.table, photograph.changed
        return {way: score(each, truth, self.plate, table, changed) for way, each in results.items()}

    def shown(self, photograph: Photograph, results: dict[str, Linear]) -> Shown:
        fit = srgb_bytes(photograph.truth)
        for mask, color in (
            (photograph.thing, (0, 255, 0)),
            (outline(photograph.cuboid, self.plane), (255, 0, 0)),
        ):
            edges, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(fit, edges, -1, color, 1)
        pictures = {way: srgb_bytes(each) for way, each in results.items()}
        return Shown(photograph.name, fit, srgb_bytes(photograph.truth), pictures)


def _filled(mask: Float64[np.ndarray, "h w"]) -> Mask:
    """Returns a mask without the hole that a thing's mask leaves around it."""
    edges, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(np.zeros_like(mask), edges, -1, 1, cv2.FILLED) > 0)


def _smooth_ratios(picture: Linear, plate: Linear, table: Mask) -> Linear:
    """Returns picture over plate, both smoothed over the table alone."""
    inside = table[..., None].astype(np.float32)
    above, below = (cv2.blur(each * inside, (SMOOTH_PX, SMOOTH_PX)) for each in (picture, plate))
    return np.asarray(above / np.maximum(below, 1e-6), np.float32)
