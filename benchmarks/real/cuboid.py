"""Cuboids that stand on the table: their geometry, their outline in the picture, and the one that fits best."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import minimize

from deltalight.benchmarks.quality.metrics import Mask
from deltalight.benchmarks.real.ranges import Plane, Points
from deltalight.protocol.errors import DeltalightError

SUB_PIXEL_BITS = 4
TOP_FRACTION = 0.8
"""Points above this fraction of the height are taken to lie on the top face."""
MARGIN_PX = 16
TURNS_DEG = (0.0, 30.0, 60.0)
STEPS = np.array([0.01, 0.01, np.radians(8), 0.01, 0.01, 0.01])
"""First steps of the search: place (m), turn (rad), size (m)."""
DEPTH_SCALE_M, DEPTH_WEIGHT = 0.01, 0.02
"""Depth decides where the outline leaves a choice; it weighs little, for its edges lie pixels off the picture's."""
SURFACE_SAMPLES = 400


@dataclass(frozen=True)
class Cuboid:
    """A cuboid on the plane z = 0: centre of its foot (m), turn about z (rad), edges along its own x, y, z (m)."""

    x_m: float
    y_m: float
    turn: float
    size_m: tuple[float, float, float]

    @property
    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """The corners in the world, m."""
        unit = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)])
        return np.asarray((unit * self.size_m) @ self._turned.T + (self.x_m, self.y_m, 0))

    @property
    def _turned(self) -> Float64[np.ndarray, "3 3"]:
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])

    def hits(
        self, origins: Points, directions: Points
    ) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
        """Returns where rays enter and leave the cuboid, in lengths of `directions`; they miss if enter > leave."""
        half = np.array(self.size_m) / 2
        centre = (self.x_m, self.y_m, half[2])
        origin, along = (origins - centre) @ self._turned, directions @ self._turned
        slope = np.where(np.abs(along) < 1e-9, 1e-9, along)
        enter, leave = np.array(-np.inf), np.array(np.inf)
        for axis, reach in enumerate(half):  # NumPy takes ten times as long to reduce so short an axis
            first, second = ((side - origin[..., axis]) / slope[..., axis] for side in (-reach, reach))
            enter = np.maximum(enter, np.minimum(first, second))
            leave = np.minimum(leave, np.maximum(first, second))
        return enter, leave


def outline(cuboid: Cuboid, plane: Plane) -> Mask:
    """Returns the pixels that a cuboid covers."""
    drawn = np.zeros((plane.camera.height, plane.camera.width), np.uint8)
    _draw(drawn, cuboid, plane, np.zeros(2))
    return np.asarray(drawn > 0)


def _draw(
    drawn: Float64[np.ndarray, "h w"], cuboid: Cuboid, plane: Plane, corner: Float64[np.ndarray, " 2"]
) -> None:
    pose = plane.world_from_camera
    seen = (cuboid.corners - pose[:3, 3]) @ pose[:3, :3]
    seen[:, 2] = np.maximum(seen[:, 2], 1e-3)
    hull = cv2.convexHull((plane.camera.project(seen) - corner).astype(np.float32))
    fixed = np.rint(hull * 2**SUB_PIXEL_BITS).astype(np.int32)
    cv2.fillConvexPoly(drawn, fixed, 1, cv2.LINE_8, SUB_PIXEL_BITS)


@dataclass(frozen=True, eq=False)
class Observed:
    """What is seen of a thing: its pixels by colour, and points (m) of it with the camera's rays to them."""

    mask: Mask
    points: Float64[np.ndarray, "n 3"]


def fit_cuboid(observed: Observed, plane: Plane) -> Cuboid:
    """Returns the cuboid whose outline and surface agree best with what is seen.

    Raises:
        DeltalightError: too little is seen of it.
    """
    if observed.mask.sum() < 100 or len(observed.points) < 100:
        raise DeltalightError("no thing stands on the table of a picture; give pictures in which one does.")
    first = rough_cuboid(observed.points)
    search = _Search.of(observed, plane)
    starts = [_parameters(replace(first, turn=first.turn + np.radians(turn))) for turn in TURNS_DEG]
    coarse = [_descend(search, start, 250) for start in starts]
    best = min(coarse, key=search.cost)
    return _cuboid(_descend(search, _descend(search, best, 400), 400))


def rough_cuboid(points: Float64[np.ndarray, "n 3"]) -> Cuboid:
    """Returns the cuboid over the smallest rectangle around the points of the top, m."""
    height = float(np.percentile(points[:, 2], 95))
    top = points[points[:, 2] > TOP_FRACTION * height, :2]
    (x, y), edges, degrees = cv2.minAreaRect(top.astype(np.float32))
    width, depth = (max(float(edge), 0.005) for edge in edges)
    return Cuboid(float(x), float(y), float(np.radians(degrees)), (width, depth, height))


def _parameters(cuboid: Cuboid) -> Float64[np.ndarray, " 6"]:
    return np.array([cuboid.x_m, cuboid.y_m, cuboid.turn, *cuboid.size_m])


def _cuboid(parameters: Float64[np.ndarray, " 6"]) -> Cuboid:
    x, y, turn, *edges = map(float, parameters)
    width, depth, height = (max(edge, 0.005) for edge in edges)
    return Cuboid(x, y, turn, (width, depth, height))


def _descend(
    search: "_Search", start: Float64[np.ndarray, " 6"], evaluations: int
) -> Float64[np.ndarray, " 6"]:
    simplex = np.vstack([start, start + np.diag(STEPS)])
    found = minimize(
        search.cost,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-5, "fatol": 1e-5},
    )
    return np.asarray(found.x)


@dataclass(frozen=True, eq=False)
class _Search:
    """The cost of a cuboid, over a window of the picture."""

    plane: Plane
    window: Bool[np.ndarray, "h w"]
    corner: Float64[np.ndarray, " 2"]
    camera_m: Float64[np.ndarray, " 3"]
    rays: Points

    @classmethod
    def of(cls, observed: Observed, plane: Plane) -> "_Search":
        rows, columns = np.nonzero(observed.mask)
        low = np.maximum((columns.min() - MARGIN_PX, rows.min() - MARGIN_PX), 0)
        window = observed.mask[low[1] : rows.max() + MARGIN_PX + 1, low[0] : columns.max() + MARGIN_PX + 1]
        camera = plane.world_from_camera[:3, 3]
        points = observed.points[:: max(1, len(observed.points) // SURFACE_SAMPLES)]
        return cls(plane, window, low.astype(np.float64), camera, points - camera)

    def cost(self, parameters: Float64[np.ndarray, " 6"]) -> float:
        """Returns the fraction of pixels that are wrong, and a little of how far the surface is off."""
        cuboid = _cuboid(parameters)
        drawn = np.zeros(self.window.shape, np.uint8)
        _draw(drawn, cuboid, self.plane, self.corner)
        wrong = np.count_nonzero((drawn > 0) != self.window) / np.count_nonzero(self.window)
        enter, leave = cuboid.hits(np.broadcast_to(self.camera_m, self.rays.shape), self.rays)
        off_m = np.abs(enter - 1) * np.linalg.norm(self.rays, axis=1)
        near = np.where(enter <= leave, np.minimum(off_m / DEPTH_SCALE_M, 1), 1)
        return float(wrong + DEPTH_WEIGHT * near.mean())
