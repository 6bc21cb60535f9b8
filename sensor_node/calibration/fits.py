"""Result of a lens calibration, for every lens model."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.fisheye_lens import FisheyeLens
from deltalight.sensor_node.calibration.views import View

# Corners are found to a few hundredths of a pixel at best: a fit with less noise has too few views.
LEAST_NOISE_PX = 0.05


@dataclass(frozen=True, eq=False)
class LensFit:
    """A lens with the views that it was fitted to.

    `misses` are, for each view, found minus predicted pixels (n, 2); `poses` camera_from_target; `focal_fraction` is
    the standard deviation of the focal length as a fraction of it. `refused` gives the reason for each view that was
    left out; `refused_points` counts single points left out of views that were kept.
    """

    lens: CameraModel | FisheyeLens
    views: tuple[View, ...]
    poses: tuple[Float64[np.ndarray, "4 4"], ...]
    misses: tuple[Float64[np.ndarray, "n 2"], ...]
    focal_fraction: float
    refused: tuple[tuple[str, str], ...] = ()
    refused_points: int = 0

    @property
    def rms_px(self) -> float:
        """Root mean square distance between found and predicted points."""
        return rms(np.concatenate(self.misses))

    @property
    def view_rms_px(self) -> Float64[np.ndarray, " v"]:
        """`rms_px` of each view."""
        return np.array([rms(misses) for misses in self.misses])

    @property
    def tilt_spread_deg(self) -> float:
        """Standard deviation of the target's normal in the direction in which it varies least, in degrees."""
        normals = np.array([pose[:3, 2] for pose in self.poses])
        mean = normals.mean(axis=0)
        across = normals - np.outer(normals @ mean, mean) / (mean @ mean)
        # The smallest of the three directions is that of the mean itself.
        variances = np.linalg.eigvalsh(across.T @ across / len(across))
        return float(np.degrees(np.sqrt(max(variances[1], 0.0))))


def rms(misses: Float64[np.ndarray, "n 2"]) -> float:
    """Returns the root mean square length of 2-D differences."""
    return float(np.sqrt(np.mean(np.sum(misses**2, axis=-1))))


def noise_px(misses: Float64[np.ndarray, "n 2"], parameters: int) -> float:
    """Returns the standard deviation of one coordinate of a point, from the residuals of a fit."""
    freedom = max(misses.size - parameters, 1)
    return max(float(np.sqrt(np.sum(misses**2) / freedom)), LEAST_NOISE_PX)
