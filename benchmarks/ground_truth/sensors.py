"""Simulation of a colour camera and a stereo depth sensor on perfect pictures: noise, holes, steps."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16


@dataclass(frozen=True)
class ColorSensor:
    """Noise variance of a linear value v (1.0 = white): shot_noise * v + read_noise^2."""

    shot_noise: float = 2.5e-5
    read_noise: float = 0.0012

    def expose(
        self, radiance: Float32[np.ndarray, "h w 3"], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Returns the 8-bit sRGB picture of linear camera units, with noise."""
        sigma = np.sqrt(self.shot_noise * np.maximum(radiance, 0) + self.read_noise**2)
        noisy = radiance + sigma * rng.standard_normal(radiance.shape, np.float32)
        return srgb_bytes(np.asarray(noisy, np.float32))


@dataclass(frozen=True)
class StereoDepthSensor:
    """Depth by matching two views, the second one `baseline_m` to the right of the first.

    Noise of standard deviation `sigma_at_1m * z^2` comes from sub-pixel disparity and is as smooth as the matching
    window (`window_px`). Pixels that the second view does not see, pixels at depth edges and a few matching failures
    are unknown (0).
    """

    focal_px: float = 600.0
    baseline_m: float = 0.05
    sigma_at_1m: float = 0.001
    window_px: float = 2.0
    edge_step: float = 0.02
    failure_fraction: float = 0.004
    step_m: float = 0.001

    def measure(
        self, depth_m: Float32[np.ndarray, "h w"], rng: np.random.Generator
    ) -> UInt16[np.ndarray, "h w"]:
        """Returns 16-bit depth in steps of `step_m` along the optical axis; 0 = unknown."""
        noise = cv2.GaussianBlur(rng.standard_normal(depth_m.shape, np.float32), (0, 0), self.window_px)
        noisy = depth_m + self.sigma_at_1m * depth_m**2 * noise / noise.std()
        known = (depth_m > 0) & ~self._edges(depth_m) & ~self._hidden(depth_m) & ~self._failures(depth_m, rng)
        return np.where(known, np.rint(noisy / self.step_m), 0).astype(np.uint16)

    def _edges(self, depth_m: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Returns the neighbourhoods whose depth range is more than `edge_step` of their depth."""
        window = np.ones((3, 3), np.uint8)
        near, far = cv2.erode(depth_m, window), cv2.dilate(depth_m, window)
        return np.asarray(far - near > self.edge_step * depth_m)

    def _hidden(self, depth_m: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Returns the pixels that something to their right covers in the second view: the occlusion shadow."""
        disparity = self.focal_px * self.baseline_m / np.maximum(depth_m, 1e-3)
        column = np.arange(depth_m.shape[1], dtype=np.float32) - disparity
        nearest_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
        return np.asarray(nearest_right < column - 0.5)

    def _failures(
        self, depth_m: Float32[np.ndarray, "h w"], rng: np.random.Generator
    ) -> Bool[np.ndarray, "h w"]:
        """Returns small blobs without a match, `failure_fraction` of all pixels."""
        field = cv2.GaussianBlur(rng.standard_normal(depth_m.shape, np.float32), (0, 0), 1.2)
        return np.asarray(field > np.quantile(field, 1 - self.failure_fraction))


def srgb_coded(linear: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Returns the sRGB code (IEC 61966-2-1), 0..255 and not yet rounded, of linear values clipped at sensor white."""
    v = np.clip(linear, 0.0, 1.0)
    coded = np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.power(v, 1 / 2.4) - 0.055)
    return np.asarray(255 * coded, np.float32)


def srgb_bytes(linear: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the 8-bit sRGB code of linear values, clipped at sensor white."""
    return np.asarray(np.rint(srgb_coded(linear)), np.uint8)
