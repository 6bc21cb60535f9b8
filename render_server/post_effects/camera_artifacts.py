"""What a camera does to a picture, learned from its frames and put on the virtual part.

In this order: vignetting, blur, sharpening, compression, noise. Noise is last because it is measured behind the
others. Where the camera's mosaic is known, noise comes before it, as at the sensor, and the compression last.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene_output import Tone
from deltalight.render_server.post_effects.camera_blur import (
    LEAST_MOTION_PX,
    NO_MOTION,
    Color,
    Coverage,
    LensBlur,
    blur_kernels,
    blurred,
    measure_blur,
)
from deltalight.render_server.post_effects.camera_compression import (
    CameraCompression,
    Compression,
    compressed,
)
from deltalight.render_server.post_effects.camera_defocus import BoardDefocus, Defocus, DistanceBlur
from deltalight.render_server.post_effects.camera_edges import edge_steps
from deltalight.render_server.post_effects.camera_mosaic import (
    GREEN_VARIANCE,
    NOISE_KEPT,
    CameraMosaic,
    Mosaic,
    mosaicked,
)
from deltalight.render_server.post_effects.camera_noise import CameraNoise, NoiseModel, add_noise
from deltalight.render_server.post_effects.camera_sharpening import CameraSharpening, Sharpening, sharpened
from deltalight.render_server.post_effects.camera_vignetting import PaperVignetting, Vignetting, vignetted
from deltalight.render_server.post_effects.tone import with_tone_curve

MOST_MEASURED = 8
"""Frames in which the lens's blur is measured."""
LONGEST_STEP_NS = 500_000_000
"""Between two frames; what a pose does for longer tells nothing about the exposure."""


@dataclass(frozen=True, eq=False)
class FrameArtifacts:
    """What is known of one frame; None: nothing."""

    frame: ViewFrame
    noise: NoiseModel | None
    kernels: Float64[np.ndarray, "3 k k"] | None
    vignetting: Vignetting | None = None
    compression: Compression | None = None
    distance_blur: DistanceBlur | None = None
    mosaic: Mosaic | None = None
    sharpening: Sharpening | None = None

    def under(self, tone: Tone) -> Self:
        """Returns what a picture gets that was made with a tone curve."""
        return replace(self, frame=with_tone_curve(self.frame, tone))

    def applied(
        self, color: Color, coverage: Coverage, depth_m: Float32[np.ndarray, "h w"] | None = None
    ) -> Color:
        """Returns a picture of the frame with all of it on its virtual part; as it is while none is known.

        `depth_m` is that of the objects (0: none), and needed where `distance_blur` is known.
        """
        frame = self.frame
        if self.vignetting is not None:
            color = vignetted(color, coverage, self.vignetting.factors(frame.camera), frame)
        if self.distance_blur is not None and depth_m is not None:
            color, coverage = self.distance_blur.applied(color, coverage, depth_m, frame.response)
        elif self.kernels is not None:
            color, coverage = blurred(color, coverage, self.kernels, frame.response)
        if self.sharpening is not None:
            color = sharpened(color, coverage, self.sharpening)
        if self.mosaic is None:
            return self._with_noise(self._compressed(color, coverage), coverage, self.noise)
        at_sensor = None if self.noise is None else self.noise.before_filter(NOISE_KEPT)
        color = self._with_noise(color, coverage, at_sensor)
        return self._compressed(*mosaicked(color, coverage, self.mosaic, frame.response))

    def _compressed(self, color: Color, coverage: Coverage) -> Color:
        return color if self.compression is None else compressed(color, coverage, self.compression)

    def _with_noise(self, color: Color, coverage: Coverage, noise: NoiseModel | None) -> Color:
        if noise is None:
            return color
        return add_noise(color, coverage, noise, self.frame.frame_id, self.frame.response)


class CameraArtifacts:
    """Learns a camera's noise, blur, sharpening, vignetting, mosaic and compression; follows its motion."""

    def __init__(self) -> None:
        self._noise = CameraNoise()
        self._vignetting = PaperVignetting()
        self._mosaic = CameraMosaic()
        self._compression = CameraCompression()
        self._defocus = BoardDefocus()
        self._sharpening = CameraSharpening()
        self._lens: list[LensBlur] = []
        self._last: ViewFrame | None = None
        self._pose: Float64[np.ndarray, "4 4"] = np.eye(4)
        self._motion_px = NO_MOTION

    def forget(self) -> None:
        """Forgets everything: other frames come from another camera."""
        self.__init__()  # type: ignore[misc]

    def observe(
        self,
        frame: ViewFrame,
        world_from_camera: Float64[np.ndarray, "4 4"],
        place_m: Float64[np.ndarray, " 3"],
    ) -> FrameArtifacts:
        """Learns from a frame, and returns what its virtual part gets. The same frame again changes nothing.

        `world_from_camera` is the pose that it is rendered with, `place_m` where the objects are (world).
        """
        self._noise.observe(frame)
        if frame is not self._last:
            self._follow(frame, world_from_camera, place_m)
            self._vignetting.observe(frame)
            self._mosaic.observe(frame)
            self._compression.observe(frame)
            self._last, self._pose = frame, world_from_camera
        from_centre = np.nan_to_num(_pixel(frame, self._pose, place_m) - frame.camera.matrix[:2, 2])
        lens, by_distance = self._lens_blur(), self._defocus.model
        by_others = self._variance_by_others(lens)
        if by_others:
            lens = None if lens is None else lens.without(by_others)
            by_distance = None if by_distance is None else by_distance.without(by_others)
        return FrameArtifacts(
            frame,
            self._noise.model,
            blur_kernels(lens, self._motion_px, from_centre),
            self._vignetting.model,
            self._compression.model,
            self._distance_blur(lens, by_distance, from_centre),
            self._mosaic.model,
            self._sharpening.model,
        )

    def _variance_by_others(self, lens: LensBlur | None) -> float:
        """Returns how much of a measured blur's variance (px^2) is not the lens's, but what objects get separately.

        Interpolation of a mosaic adds some; sharpening makes it less.
        """
        sharpening = self._sharpening.model
        by_mosaic = 0.0 if self._mosaic.model is None else GREEN_VARIANCE
        by_sharpening = 0.0 if sharpening is None or lens is None else lens.sigma_px**2 - sharpening.variance
        return by_mosaic + by_sharpening

    def _distance_blur(
        self, lens: LensBlur | None, defocus: Defocus | None, from_centre_px: Float64[np.ndarray, " 2"]
    ) -> DistanceBlur | None:
        if defocus is None:
            return None
        return DistanceBlur(defocus, lens or LensBlur(0.0), self._motion_px, from_centre_px)

    def _lens_blur(self) -> LensBlur | None:
        """Returns the medians of what was measured."""
        if not self._lens:
            return None
        sigma, red, blue = np.median([(each.sigma_px, each.red, each.blue) for each in self._lens], axis=0)
        return LensBlur(float(sigma), float(red), float(blue))

    def _follow(
        self, frame: ViewFrame, pose: Float64[np.ndarray, "4 4"], place_m: Float64[np.ndarray, " 3"]
    ) -> None:
        """Finds how far the objects' place moves in the picture; where it hardly does, measures the lens's blur."""
        last = self._last
        step_ns = 0 if last is None else frame.timestamp_ns - last.timestamp_ns
        moved = NO_MOTION
        if 0 < step_ns <= LONGEST_STEP_NS:
            moved = _pixel(frame, pose, place_m) - _pixel(frame, self._pose, place_m)
            moved = moved if np.isfinite(moved).all() else NO_MOTION
        known = frame.exposure_s is not None
        self._motion_px = moved * min((frame.exposure_s or 0.0) * 1e9 / max(step_ns, 1), 1.0)
        is_still = float(np.linalg.norm(self._motion_px if known else moved)) < LEAST_MOTION_PX
        wants_lens, wants_defocus = len(self._lens) < MOST_MEASURED, self._defocus.wants(frame)
        if not is_still or not (wants_lens or wants_defocus):
            return
        edges = edge_steps(frame)
        if wants_lens:
            found = measure_blur(edges)
            if found is not None:
                self._lens.append(found)
                self._sharpening.observe(edges, frame.response)
        if wants_defocus:
            self._defocus.observe(frame, edges)


def _pixel(
    frame: ViewFrame, pose: Float64[np.ndarray, "4 4"], place_m: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 2"]:
    """Returns where a place is in the picture; NaN behind the camera."""
    seen = (place_m - pose[:3, 3]) @ pose[:3, :3]
    return np.asarray(frame.camera.project(seen[None])[0] if seen[2] > 0 else np.full(2, np.nan))
