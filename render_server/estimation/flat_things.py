"""Flat things that nobody declared on mirroring planes: where the picture lacks the reflection that it should show.

An area of one colour with sharp edges, over which the plane's predicted reflection varies much, is no mirror. Neither
texture nor shadow can make a mirror look even: they would have to cancel the reflection everywhere. Where the
prediction varies little, or is unknown, nothing is concluded.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.frames import linear_color
from deltalight.protocol.scene_objects import Surface
from deltalight.render_server.estimation.samples import BackoffSchedule
from deltalight.render_server.lights.mirror_lights import MIRROR_ROUGHNESS
from deltalight.render_server.scene.declared_surfaces import (
    MAX_FOUND,
    PLANE,
    SurfaceTable,
    build_surface_table,
)
from deltalight.render_server.scene.plane_reflection import MirrorPlane, PlaneReflection, plane_reflection
from deltalight.render_server.view import PosedFrame

WIDTH_PX = 320  # at which pictures are searched
EDGE_NOISES = 4.0  # how many times the median change from pixel to pixel makes an edge
LEAST_EDGE = 0.02  # relative change from pixel to pixel, below which there is none
DARK = 0.05  # of sensor white: below, changes count absolutely, because noise does not become less
LEAST_AREA_PX, LEAST_KNOWN_PX = 200, 100
MOST_AREAS = 16  # of a plane, the largest; tiles and bricks have many more
LEAST_SPREAD = 0.02  # of sensor white: what depth errors and reflections out of sight leave uncertain
CONTRADICTION = 3.0  # how many times as much as the picture the reflection varies; at most 1.2 in mirrors
LEAST_FILL = 0.7  # of its rectangle: other shapes are no sheets
EDGE_PX = 2  # within which an edge blurs an area
ERROR_PX = 4  # by which a prediction may be beside the picture, because depth errs
SAME_COLOUR, LEAST_SEEN_PX = 0.25, 50
SPREAD_PERCENTILES = 10, 90

Outline = Float64[np.ndarray, "4 3"]
Mask = Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class FlatThing:
    """A sheet: its outline (world, m) and its colour when it was found (linear R G B)."""

    outline: Outline
    colour: Float64[np.ndarray, "3"]


class FlatThings:
    """Searches one camera's frames for sheets on mirroring planes, less and less often."""

    def __init__(self) -> None:
        self._schedule = BackoffSchedule()
        self._found: list[FlatThing] = []

    def update(self, seen: PosedFrame, declared: SurfaceTable) -> list[Outline]:
        """Returns the sheets' outlines, searched for in a frame if that is due.

        A sheet stays until something else is where it lay: that its plane mirrors little there, from another
        viewpoint, is no reason to forget it.
        """
        planes = mirror_planes(declared)
        if planes and seen.frame.depth is not None and self._schedule.is_due(seen.frame.timestamp_ns):
            small = _reduced(seen)
            kept = [each for each in self._found if _is_there(small, each)]
            new = [each for plane in planes for each in find_sheets(small, plane, declared)]
            kept += [each for each in new if not any(_overlap(each, other) for other in kept)]
            self._found = kept[:MAX_FOUND]
        return [each.outline for each in self._found]


class SurfaceTables:
    """The real scene's surfaces: declared ones, the board's sheet, and sheets that are found on them."""

    def __init__(self) -> None:
        self._things = FlatThings()
        self._table: SurfaceTable | None = None

    def update(
        self, declared: Sequence[Surface], seen: PosedFrame, material_names: Sequence[str], *, moved: bool
    ) -> SurfaceTable:
        """Returns the table for a frame, compiled anew when something moved: the same object if nothing changed."""
        if self._table is None or moved:
            board = seen.frame.board if declared else None
            plain = build_surface_table(declared, board, material_names)
            found = self._things.update(seen, plain)
            table = build_surface_table(declared, board, material_names, found) if found else plain
            if self._table is None or not table.equals(self._table):
                self._table = table
        return self._table


def mirror_planes(declared: SurfaceTable) -> list[MirrorPlane]:
    """Returns the planes that are smooth enough for their reflections to be told."""
    rows = [row.astype(np.float64) for row in declared.packed]
    return [
        MirrorPlane(row[3, :3], row[4, :3], row[0, :3], float(row[1, 0]), float(row[4, 3]))
        for row in rows
        if row[3, 3] == PLANE and row[1, 0] < MIRROR_ROUGHNESS and row[0, :3].any()
    ]


def find_sheets(seen: PosedFrame, plane: MirrorPlane, declared: SurfaceTable) -> list[FlatThing]:
    """Returns rectangular sheets on a plane by a frame with depth, the largest first."""
    reflection = plane_reflection(seen, plane)
    if reflection is None:
        return []
    bare = reflection.on_plane & ~np.any([_inside(seen, each) for each in declared.sheets], axis=0)
    found, smooth = [], cv2.GaussianBlur(reflection.picture, (0, 0), 1.0)
    for area in _even_areas(smooth, bare):
        if _contradicts(reflection, smooth, area):
            sheet = _sheet(seen, plane, reflection, area)
            found += [] if sheet is None else [sheet]
    return sorted(found, key=_area_m2, reverse=True)


def _reduced(seen: PosedFrame) -> PosedFrame:
    width, height = seen.view.size
    return seen.at((WIDTH_PX, max(round(height * WIDTH_PX / width), 1))) if width > WIDTH_PX else seen


def _even_areas(smooth: Float32[np.ndarray, "h w 3"], bare: Mask) -> Iterator[Mask]:
    """Yields the areas of a bare plane that sharp edges of the picture enclose, the largest ones."""
    log = np.log(smooth + DARK)
    steps = [cv2.Sobel(log, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (0, 1)]
    change = np.abs(np.dstack(steps)).max(axis=2)
    if not bare.any():
        return
    least = max(EDGE_NOISES * float(np.median(change[bare])), LEAST_EDGE)
    even = (bare & (change <= least)).astype(np.uint8)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(even, connectivity=4)
    sizes = statistics[1:, cv2.CC_STAT_AREA]
    for index in np.argsort(-sizes, kind="stable")[:MOST_AREAS]:
        if sizes[index] >= LEAST_AREA_PX:
            yield labels == index + 1


def _contradicts(reflection: PlaneReflection, smooth: Float32[np.ndarray, "h w 3"], area: Mask) -> bool:
    """Returns whether the predicted reflection varies much over an area, and the picture hardly."""
    inner = cv2.erode(area.astype(np.uint8), np.ones((2 * ERROR_PX + 1,) * 2), borderValue=0) > 0
    rows, columns = np.nonzero(inner & reflection.known)
    if len(rows) < LEAST_KNOWN_PX:
        return False
    even = np.column_stack([np.ones(len(rows)), columns, rows])
    expected, found = (_spread(values[rows, columns], even) for values in (reflection.expected, smooth))
    return expected >= max(LEAST_SPREAD, CONTRADICTION * found)


def _spread(values: Float32[np.ndarray, "n 3"], even: Float64[np.ndarray, "n 3"]) -> float:
    """Returns how far values spread about an even slope, in the channel where they do most."""
    slope, *_ = np.linalg.lstsq(even, values, rcond=None)
    low, high = np.percentile(values - even @ slope, SPREAD_PERCENTILES, axis=0)
    return float((high - low).max())


def _sheet(seen: PosedFrame, plane: MirrorPlane, reflection: PlaneReflection, area: Mask) -> FlatThing | None:
    """Returns the rectangle on the plane that an area fills; None if its shape is another."""
    whole = cv2.dilate(area.astype(np.uint8), np.ones((2 * EDGE_PX + 1,) * 2)) > 0
    edge = np.linalg.svd(plane.normal[None])[2][1]
    axes = np.stack([edge, np.cross(plane.normal, edge)])
    points = (_on_plane(seen, plane, whole) - plane.point) @ axes.T
    # In millimetres: OpenCV rounds to single precision.
    corners = cv2.boxPoints(cv2.minAreaRect((1e3 * points).astype(np.float32))).astype(np.float64) / 1e3
    outline = plane.point + corners @ axes
    inside = _inside(seen, outline)
    if not inside.any() or np.count_nonzero(whole & inside) < LEAST_FILL * np.count_nonzero(inside):
        return None
    return FlatThing(outline, np.median(reflection.picture[area], axis=0).astype(np.float64))


def _on_plane(seen: PosedFrame, plane: MirrorPlane, pixels: Mask) -> Float64[np.ndarray, "n 3"]:
    """Returns where pixels that show a plane's points lie on it, world."""
    pose, rays = seen.view.world_from_camera, seen.view.camera.rays()[pixels]
    towards = np.column_stack([rays, np.ones(len(rays))]) @ pose[:3, :3].T
    away = ((plane.point - pose[:3, 3]) @ plane.normal) / (towards @ plane.normal)
    return np.asarray(pose[:3, 3] + towards * away[:, None])


def _inside(seen: PosedFrame, outline: Outline) -> Mask:
    """Returns the pixels within an outline; none if it reaches behind the camera."""
    pose, camera = seen.view.world_from_camera, seen.view.camera
    local, mask = (outline - pose[:3, 3]) @ pose[:3, :3], np.zeros((camera.height, camera.width), np.uint8)
    if (local[:, 2] > 0).all():
        cv2.fillConvexPoly(mask, np.rint(camera.project(local)).astype(np.int32), 1)
    return mask > 0


def _is_there(seen: PosedFrame, thing: FlatThing) -> bool:
    """Returns whether a sheet has its colour still, as far as it is in view."""
    inside = _inside(seen, thing.outline)
    if np.count_nonzero(inside) < LEAST_SEEN_PX:
        return True
    colour = np.median(linear_color(seen.frame, seen.frame.color)[inside], axis=0)
    return bool((np.abs(colour - thing.colour) <= SAME_COLOUR * thing.colour + LEAST_SPREAD).all())


def _overlap(one: FlatThing, other: FlatThing) -> bool:
    """Returns whether the middle of a sheet lies on another."""
    outline = other.outline
    edges = np.stack([outline[1] - outline[0], outline[3] - outline[0]])
    along = (edges @ (one.outline.mean(axis=0) - outline[0])) / (edges**2).sum(axis=1)
    return bool(((along >= 0) & (along <= 1)).all())


def _area_m2(thing: FlatThing) -> float:
    edge, other = thing.outline[1] - thing.outline[0], thing.outline[3] - thing.outline[0]
    return float(np.linalg.norm(np.cross(edge, other)))
