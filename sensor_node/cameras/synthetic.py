"""A camera without hardware: it circles above a synthetic scene with known ground truth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.sensor_node.cameras.replay import PacedCamera
from deltalight.sensor_node.cameras.synthetic_scene import SAMPLES_PER_EDGE, SHEET_MARGIN, SyntheticScene

FRAMES_PER_ROUND = 90
PERIOD_NS = 33_333_333
SWAY_RAD = 0.5
TILT_RAD = 0.75


@dataclass(frozen=True)
class SyntheticNoise:
    """Noise of the synthetic sensors, reproducible by seed and frame.

    `color_sigma` is the standard deviation of linear colour (1.0 = sensor white), `depth_sigma_m` that of depth at 1
    m (it grows with z^2), `hole_fraction` the fraction of depth pixels without a reading.
    """

    color_sigma: float = 0.004
    depth_sigma_m: float = 0.002
    hole_fraction: float = 0.01
    seed: int = 0


def default_board() -> BoardSpec:
    """Returns the board of the synthetic scene: a grid of 3x4 ArUco markers of 5 cm."""
    return BoardSpec.model_validate(
        {
            "type": "aruco_grid",
            "dictionary": "DICT_4X4_50",
            "marker_length_m": 0.05,
            "separation_m": 0.015,
            "rows": 3,
            "columns": 4,
            "margins_m": (SHEET_MARGIN * 0.05,) * 4,
        }
    )


def default_camera() -> CameraModel:
    """Returns the camera of the synthetic scene: 640x480, 65 degrees wide, without distortion."""
    return CameraModel(640, 480, np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]))


class SyntheticCamera(PacedCamera):
    """Frames of a `SyntheticScene`: sRGB colour, depth registered to it, and no given pose.

    Marker detection should find the pose; `pose_at` returns the true one. Without `noise` depth is exact. A round of
    the path has FRAMES_PER_ROUND frames, `period_ns` apart.
    """

    def __init__(
        self,
        board: BoardSpec | None = None,
        camera: CameraModel | None = None,
        *,
        noise: SyntheticNoise | None = None,
        period_ns: int = PERIOD_NS,
        realtime: bool = False,
        loop: bool = True,
    ) -> None:
        times = [number * period_ns for number in range(FRAMES_PER_ROUND)]
        super().__init__(times, realtime=realtime, loop=loop)
        self.board = board or default_board()
        self.camera = camera or default_camera()
        self.scene = SyntheticScene(self.board)
        self._fine = self.camera.resized(
            self.camera.width * SAMPLES_PER_EDGE, self.camera.height * SAMPLES_PER_EDGE
        )
        self._noise, self._period_ns = noise, period_ns

    def pose_at(self, index: int) -> Float64[np.ndarray, "4 4"]:
        """Returns the true world_from_camera of a frame, swaying in front of the board's middle."""
        phase = 2 * np.pi * (index % FRAMES_PER_ROUND) / FRAMES_PER_ROUND
        sway, tilt = SWAY_RAD * np.sin(phase), TILT_RAD + 0.1 * np.cos(phase)
        # The board fills about half the picture's width.
        distance = 1.1 * self.scene.extent_m * self.camera.matrix[0, 0] / self.camera.width * 2
        away = np.array([np.sin(sway) * np.sin(tilt), -np.cos(sway) * np.sin(tilt), np.cos(tilt)])
        right = np.cross([0, 0, 1.0], away)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([right, np.cross(-away, right), -away])
        pose[:3, 3] = self.scene.aim + distance * away
        return pose

    def frame_at(self, index: int) -> SensorFrame:
        """Returns the frame of the path's first round."""
        pose = self.pose_at(index)
        linear = self.scene.picture(self._fine, pose)
        depth_m = self.scene.trace(self.camera, pose).depth_m
        sigma = None
        if self._noise is not None:
            random = np.random.default_rng((self._noise.seed, index))
            linear += random.normal(0, self._noise.color_sigma, linear.shape)
            depth_m += random.normal(0, self._noise.depth_sigma_m, depth_m.shape) * depth_m**2
            depth_m[random.random(depth_m.shape) < self._noise.hole_fraction] = 0
            sigma = self._noise.depth_sigma_m
        timestamp_ns = index * self._period_ns
        return SensorFrame(
            frame_id=index,
            timestamp_ns=timestamp_ns,
            color=srgb_codes(linear),
            camera=self.camera,
            depth=DepthImage(depth_m, depth_m > 0, self.camera, sigma),
            depth_timestamp_ns=timestamp_ns,
        )


def _srgb_table(size: int) -> UInt8[np.ndarray, " n"]:
    light = np.linspace(0, 1, size)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(coded * 255), np.uint8)


# Fine enough to reach every code: the steepest slope of the curve is 12.92.
_SRGB_OF_LINEAR = _srgb_table(1 << 14)


def srgb_codes(linear: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the 8-bit sRGB codes of linear light (IEC 61966-2-1)."""
    steps = np.clip(linear * (len(_SRGB_OF_LINEAR) - 1) + 0.5, 0, len(_SRGB_OF_LINEAR) - 1)
    return np.asarray(_SRGB_OF_LINEAR[steps.astype(np.int32)])
