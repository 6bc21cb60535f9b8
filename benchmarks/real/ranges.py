"""The plane that a range image shows, where neither the camera's place nor the ranges' origin is known.

A range image holds the distance of each pixel's point to an origin o, which need not be the camera: robots store
distances to their own base. With unit normal n (away from the camera) and distance h of a plane that the camera sees,
the point on ray r is X = r h / (n.r), and its range |X - o|. Plane and origin are those that fit the ranges best.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import least_squares

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError

FITTED_POINTS = 8000
INLIER_M, PLANE_RMS_M = 0.005, 0.005
"""Ranges that agree with the plane, and what their rms may be at most: range cameras at 1 m are that exact."""
START = ((0.0, 0.0), (0.0, 0.6), (0.0, 0.9))
"""x and y of the normals from which the search begins: the camera looks straight at the plane, or down at it."""

Values = Float64[np.ndarray, "h w"]
Points = Float64[np.ndarray, "*n 3"]


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that the camera sees. World: z = 0 on it, z towards the camera, origin where the optical axis meets it.

    `normal` (3,) is a unit vector away from the camera, `distance_m` the camera's height over the plane, `origin_m`
    (3,) the ranges' origin, all in the camera's frame; `rms_m` of the ranges that were fitted.
    """

    camera: CameraModel
    normal: Float64[np.ndarray, " 3"]
    distance_m: float
    origin_m: Float64[np.ndarray, " 3"]
    rms_m: float

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"]:
        """The camera's pose."""
        up = -self.normal
        right = np.array([1.0, 0.0, 0.0]) - self.normal[0] * self.normal
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(up, right), up])
        pose[:3, 3] = -pose[:3, :3] @ [0, 0, self.distance_m / self.normal[2]]
        return pose

    @property
    def depth_m(self) -> Values:
        """Depth of the plane along the optical axis at every pixel; 0 where the ray does not meet it."""
        slope = _rays(self.camera) @ self.normal
        return np.asarray(np.divide(self.distance_m, slope, out=np.zeros_like(slope), where=slope > 1e-6))

    def points(self, depth_m: Values) -> Float64[np.ndarray, "h w 3"]:
        """Returns the world's points at a depth along the optical axis."""
        pose = self.world_from_camera
        return np.asarray((_rays(self.camera) * depth_m[..., None]) @ pose[:3, :3].T + pose[:3, 3])

    def depth_of_ranges(self, ranges_m: Values) -> Values:
        """Returns the depth along the optical axis for ranges; of two points on a ray, that nearer the plane."""
        rays = _rays(self.camera)
        square, along = (rays**2).sum(-1), rays @ self.origin_m
        root = np.sqrt(np.maximum(along**2 - square * (self.origin_m @ self.origin_m - ranges_m**2), 0))
        solutions = np.stack([along + root, along - root]) / square
        nearer = np.abs(solutions - self.depth_m).argmin(axis=0)
        return np.asarray(np.take_along_axis(solutions, nearer[None], axis=0)[0])


def _rays(camera: CameraModel) -> Float64[np.ndarray, "h w 3"]:
    rays = camera.rays().astype(np.float64)
    return np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)


def fit_plane(
    camera: CameraModel, ranges_m: Values, seen: Bool[np.ndarray, "h w"], *, at_camera: bool
) -> Plane:
    """Returns the plane that most of the `seen` pixels show; `at_camera`: ranges are distances to the camera.

    Raises:
        DeltalightError: they show no plane.
    """
    places = np.flatnonzero(seen & (ranges_m > 0))
    places = places[:: max(1, len(places) // FITTED_POINTS)]
    if len(places) < 100:
        raise DeltalightError(
            "the range image shows too little of a table; give pictures whose depth is complete."
        )
    rays, found = _rays(camera).reshape(-1, 3)[places], ranges_m.reshape(-1)[places]
    best = min((_fit(rays, found, at_camera, start) for start in START), key=lambda plane: plane[1])
    parameters, rms = best
    if not rms < PLANE_RMS_M:
        raise DeltalightError(
            f"the range image fits a plane only within {1000 * rms:.0f} mm; it must show an even table."
        )
    return Plane(camera, _normal(parameters), float(parameters[2]), _origin(parameters), rms)


def _fit(
    rays: Points, ranges_m: Float64[np.ndarray, " n"], at_camera: bool, start: tuple[float, float]
) -> tuple[Float64[np.ndarray, " k"], float]:
    def errors(parameters: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " n"]:
        slope = np.maximum(rays @ _normal(parameters), 1e-3)
        points = rays * (parameters[2] / slope)[:, None]
        return np.asarray(np.linalg.norm(points - _origin(parameters), axis=1) - ranges_m)

    first = np.array([*start, np.median(ranges_m), *(() if at_camera else (0.0, 0.0, 0.0))])
    parameters = first
    for loss in ("linear", "soft_l1", "cauchy"):  # ever less is made of what stands on the table
        parameters = least_squares(errors, parameters, x_scale=0.1, loss=loss, f_scale=INLIER_M / 2).x
    found = errors(parameters)
    agreeing = found[np.abs(found) < INLIER_M]
    rms = float(np.sqrt(np.mean(agreeing**2))) if 2 * len(agreeing) > len(found) else np.inf
    return parameters, rms


def _normal(parameters: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " 3"]:
    x, y = parameters[:2]
    normal = np.array([x, y, np.sqrt(max(1e-6, 1 - x * x - y * y))])
    return np.asarray(normal / np.linalg.norm(normal))


def _origin(parameters: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " 3"]:
    return np.asarray(parameters[3:6]) if len(parameters) > 3 else np.zeros(3)
