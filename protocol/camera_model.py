"""Cameras: intrinsics, lens distortion, rays and projection, and their ROS camera_info files."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self
from weakref import WeakValueDictionary

import cv2
import numpy as np
import yaml
from jaxtyping import Float32, Float64

from deltalight.protocol import short_axis
from deltalight.protocol.documents import read_mapping
from deltalight.protocol.errors import DeltalightError

DistortionModel = Literal["plumb_bob", "equidistant"]
DISTORTION_LENGTHS: dict[str, tuple[int, ...]] = {"plumb_bob": (0, 4, 5, 8, 12, 14), "equidistant": (0, 4)}
MAX_EDGE = 16384
RAY_TOLERANCE_PX = 0.05
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)

# Of the cameras that exist, by value: each frame brings its camera anew.
_RAYS: WeakValueDictionary[tuple[int | float | str, ...], Float32[np.ndarray, "h w 2"]] = (
    WeakValueDictionary()
)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Size, intrinsics and lens of a camera; pixel centres are at integers (docs/method.md 1).

    `matrix` is (3, 3) without skew. `distortion` holds OpenCV's coefficients: `plumb_bob` 4, 5, 8, 12 or 14,
    `equidistant` 4 (Kannala & Brandt); empty or zeros = no distortion.

    Raises:
        DeltalightError: impossible sizes, focal lengths or coefficients.
    """

    width: int
    height: int
    matrix: Float64[np.ndarray, "3 3"]
    distortion_model: DistortionModel = "plumb_bob"
    distortion: Float64[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _frozen_array(self.matrix, "the camera matrix"))
        object.__setattr__(self, "distortion", _frozen_array(self.distortion, "the distortion"))
        self._check()

    def _check(self) -> None:
        if not (1 <= self.width <= MAX_EDGE and 1 <= self.height <= MAX_EDGE):
            raise DeltalightError(
                f"a camera of {self.width}x{self.height} pixels is outside 1..{MAX_EDGE}; correct its size."
            )
        matrix, lengths = self.matrix, DISTORTION_LENGTHS.get(self.distortion_model)
        if matrix.shape != (3, 3) or not np.array_equal(
            matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]
        ):
            raise DeltalightError(
                "the camera matrix must be 3x3, [fx 0 cx; 0 fy cy; 0 0 1]; correct the calibration."
            )
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise DeltalightError("the camera's focal lengths must be positive; correct the calibration.")
        if lengths is None:
            known = " or ".join(DISTORTION_LENGTHS)
            raise DeltalightError(
                f"the distortion model `{self.distortion_model:.60}` is unknown; use {known}."
            )
        if self.distortion.shape not in {(length,) for length in lengths}:
            raise DeltalightError(
                f"{self.distortion_model} has no form of {self.distortion.size} coefficients; "
                f"give one of {lengths}."
            )

    def __eq__(self, other: object) -> bool:
        """Compares by value."""
        return isinstance(other, CameraModel) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    @cached_property
    def _values(self) -> tuple[int | float | str, ...]:
        """All that tells cameras apart."""
        numbers = (*self.matrix.ravel().tolist(), *self.distortion.tolist())
        return (self.width, self.height, self.distortion_model, *numbers)

    @cached_property
    def has_distortion(self) -> bool:
        """Whether rays differ from a pinhole's (`equidistant` with zeros is still a fish-eye)."""
        return self.distortion_model == "equidistant" or bool(self.distortion.any())

    def rays(self) -> Float32[np.ndarray, "h w 2"]:
        """Returns (x/z, y/z) of the ray through every pixel centre, by the full lens model.

        The array is computed once, as long as any camera of these values keeps it, and is read-only.

        Raises:
            DeltalightError: the lens model has no ray for some pixel (it folds inside the picture).
        """
        return self._rays

    @cached_property
    def _rays(self) -> Float32[np.ndarray, "h w 2"]:
        known = _RAYS.get(self._values)
        if known is None:
            known = _RAYS[self._values] = self._find_rays()
        return known

    def _find_rays(self) -> Float32[np.ndarray, "h w 2"]:
        columns, rows = np.meshgrid(
            np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64)
        )
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        rays = self.unproject(pixels)
        back = self.project(np.column_stack([rays, np.ones(len(rays))]))
        lost = ~(short_axis.greatest(np.abs(back - pixels)) < RAY_TOLERANCE_PX)
        if lost.any():
            raise DeltalightError(
                f"the lens model has no ray for {lost.sum()} of {lost.size} pixels; "
                "calibrate with fewer coefficients or with pictures that reach the corners."
            )
        result = rays.reshape(self.height, self.width, 2).astype(np.float32)
        result.flags.writeable = False
        return result

    def unproject(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Returns (x/z, y/z) of the rays through `pixels` (x, y); the inverse of `project`."""
        points = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        if not self.has_distortion:
            focal, centre = self.matrix[[0, 1], [0, 1]], self.matrix[:2, 2]
            rays = (points[:, 0] - centre) / focal
        elif self.distortion_model == "equidistant":
            rays = cv2.fisheye.undistortPoints(
                points, self.matrix, self._fisheye_coefficients, criteria=_CRITERIA
            )
        elif hasattr(
            cv2, "undistortPointsIter"
        ):  # OpenCV 4 takes the termination criteria in a separate function
            rays = cv2.undistortPointsIter(
                points, self.matrix, self.distortion, np.eye(3), np.eye(3), _CRITERIA
            )
        else:
            rays = cv2.undistortPoints(points, self.matrix, self.distortion, criteria=_CRITERIA)
        return np.asarray(rays, np.float64).reshape(-1, 2)

    def project(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Returns the pixels (x, y) of points in the optical frame; NaN for points not in front (z <= 0)."""
        in_front = points[:, 2] > 0
        if len(points) and in_front.all():
            return self._project_in_front(np.asarray(points, np.float64))
        pixels = np.full((len(points), 2), np.nan)
        if in_front.any():
            pixels[in_front] = self._project_in_front(np.asarray(points[in_front], np.float64))
        return pixels

    def _project_in_front(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        if not self.has_distortion:
            pixels = np.empty((2, len(points)))
            for axis in (0, 1):  # each by itself: NumPy is slow along rows of two
                focal, centre = self.matrix[axis, axis], self.matrix[axis, 2]
                pixels[axis] = points[:, axis] / points[:, 2] * focal + centre
            return pixels.T
        zero = np.zeros(3)
        shaped = np.ascontiguousarray(points).reshape(-1, 1, 3)
        if self.distortion_model == "equidistant":
            pixels, _ = cv2.fisheye.projectPoints(shaped, zero, zero, self.matrix, self._fisheye_coefficients)
        else:
            pixels, _ = cv2.projectPoints(shaped, zero, zero, self.matrix, self.distortion)
        return np.asarray(pixels, np.float64).reshape(-1, 2)

    @property
    def _fisheye_coefficients(self) -> Float64[np.ndarray, "4"]:
        return self.distortion if self.distortion.size else np.zeros(4)

    def resized(self, width: int, height: int) -> "CameraModel":
        """Returns the camera of the same picture resampled to another size (pixel centres stay correct)."""
        scale = np.array([width / self.width, height / self.height])
        matrix = self.matrix.copy()
        matrix[[0, 1], [0, 1]] *= scale
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
        return CameraModel(width, height, matrix, self.distortion_model, self.distortion)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values that msgpack, JSON and YAML can hold."""
        return {
            "width": self.width,
            "height": self.height,
            "matrix": self.matrix.ravel().tolist(),
            "distortion_model": self.distortion_model,
            "distortion": self.distortion.tolist(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Creates the camera from the data of `to_dict`.

        Raises:
            DeltalightError: a key is missing or has an impossible value.
        """
        try:
            matrix = np.asarray(data["matrix"], np.float64).reshape(3, 3)
            distortion = np.asarray(data["distortion"], np.float64)
            return cls(int(data["width"]), int(data["height"]), matrix, data["distortion_model"], distortion)
        except (KeyError, TypeError, ValueError) as error:
            raise DeltalightError(
                f"a camera description is malformed ({error!r:.300}); send all of its fields."
            ) from error


def _frozen_array(values: object, name: str) -> Float64[np.ndarray, "..."]:
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise DeltalightError(f"{name} must hold numbers only; correct the calibration.") from None
    if not np.isfinite(array).all():
        raise DeltalightError(f"{name} holds a number that is not finite; correct the calibration.")
    array.flags.writeable = False
    return array


def load_camera_yaml(path: Path) -> CameraModel:
    """Reads a ROS camera_info YAML file (matrices as `{rows, cols, data}` or as plain lists).

    Raises:
        DeltalightError: the file or one of its keys is missing or wrong.
    """
    return camera_from_info(read_mapping(path), path)


def camera_from_info(info: Mapping[str, Any], path: Path) -> CameraModel:
    """Creates a camera from the keys of a ROS camera_info file; `path` names the file in errors."""
    try:
        width, height = int(info["image_width"]), int(info["image_height"])
        matrix = _info_values(info["camera_matrix"]).reshape(3, 3)
        distortion = _info_values(info.get("distortion_coefficients") or [])
        return CameraModel(width, height, matrix, info.get("distortion_model") or "plumb_bob", distortion)
    except KeyError as error:
        raise DeltalightError(f"{path} has no `{error.args[0]}`; write a ROS camera_info file.") from error
    except (TypeError, ValueError) as error:
        raise DeltalightError(
            f"{path} is not a ROS camera_info file ({error}); correct its values."
        ) from error
    except DeltalightError as error:
        raise DeltalightError(f"{path}: {error}") from error


def _info_values(value: Any) -> Float64[np.ndarray, " n"]:  # noqa: ANN401 - whatever the file holds
    data = value["data"] if isinstance(value, Mapping) else value
    return np.asarray(data, np.float64).ravel()


def save_camera_yaml(
    path: Path, model: CameraModel, name: str, extra: Mapping[str, object] | None = None
) -> None:
    """Writes a ROS camera_info YAML file; `extra` adds keys (such as `depth_scale`) at its end."""
    described = model.to_dict()
    distortion = described["distortion"]
    info = {
        "image_width": model.width,
        "image_height": model.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": described["matrix"]},
        "distortion_model": model.distortion_model,
        "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": distortion},
        **(extra or {}),
    }
    path.write_text(yaml.safe_dump(info, sort_keys=False, default_flow_style=None), encoding="utf-8")
