"""Data from cameras to the renderer: pictures, depth, poses."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.sky_lights import SkyLights

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Weights of linear R G B (ITU-R BT.709)."""


@dataclass(frozen=True, eq=False)
class BoardPose:
    """The camera's pose in one picture, from the marker board.

    `world_from_camera` is (4, 4); `alternative` is the other solution of the planar ambiguity, if known.
    """

    world_from_camera: Float64[np.ndarray, "4 4"]
    reprojection_error_px: float | None = None
    alternative: Float64[np.ndarray, "4 4"] | None = None


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Depth in metres along the optical axis.

    `depth_m` is 0 where unknown; `valid` is the corresponding mask. `camera` is the depth image's own camera, equal
    to the colour camera if registered. `noise_sigma_m` is the noise at 1 m; it grows with the square of the distance.
    """

    depth_m: Float32[np.ndarray, "h w"]
    valid: Bool[np.ndarray, "h w"]
    camera: CameraModel
    noise_sigma_m: float | None = None

    def resized(self, width: int, height: int) -> "DepthImage":
        """Returns each pixel of another size from the pixel that its centre lies in.

        A mean over an edge would be a surface where there is none.
        """
        depth_m, valid = (
            cv2.resize(plane, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
            for plane in (self.depth_m, self.valid.view(np.uint8))
        )
        return DepthImage(depth_m, valid.view(bool), self.camera.resized(width, height), self.noise_sigma_m)


@dataclass(frozen=True, eq=False)
class FisheyePictures:
    """A fish-eye picture, or an exposure bracket of one moment; current until the next one.

    `pictures` are RGB: uint8 is camera-coded (by the calibration's response), float32 is linear. An exposure of None
    is the reference exposure. Frames with the same current pictures share one object.
    """

    timestamp_ns: int
    pictures: tuple[UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w 3"], ...]
    exposures_s: tuple[float | None, ...]
    calibration: FisheyeCalibration


@dataclass(frozen=True, eq=False)
class RadianceMap:
    """Radiance that reaches the fish-eye camera from the hemisphere about its axis (docs/method.md 2).

    `radiance` is linear R G B in the fish-eye camera's units (1.0 = its white at the reference exposure) on the grid
    of `deltalight.protocol.hemisphere`, in the axes of its optical frame; 0 where not `seen`. `clipped_share` is the
    fraction of the seen solid angle that even the shortest exposure clips (so its radiance is a lower bound).
    `picture` (coded, RGB) is for display.
    """

    timestamp_ns: int
    radiance: Float32[np.ndarray, "n n 3"]
    seen: Bool[np.ndarray, "n n"]
    world_from_fisheye: Float64[np.ndarray, "4 4"]
    clipped_share: float
    picture: UInt8[np.ndarray, "h w 3"]
    calibration: FisheyeCalibration


@dataclass(frozen=True, eq=False)
class LampPose:
    """A marker fixed to a lamp, as seen by the camera: point_world = world_from_marker @ point_marker (4, 4)."""

    marker: int
    world_from_marker: Float64[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """One raw picture with its depth, as captured or recorded.

    `frame_id` is the zero-based index of the line in rgb.txt for datasets. `color` is RGB, camera-coded. `response`
    is linear R G B for each code (None = sRGB). `exposure_s` None = reference exposure. `world_from_camera` is a
    given pose, if any. `color_jpeg` holds the encoded bytes if the source has them. `fisheye` are the current
    fish-eye pictures. `found_pose` is what a node once found by the marker board: for viewers, because whoever
    renders the frame finds it again. `composite` is the picture that a render server once made of it, JPEG or PNG.
    """

    frame_id: int
    timestamp_ns: int
    color: UInt8[np.ndarray, "h w 3"]
    camera: CameraModel
    response: Float32[np.ndarray, "256 3"] | None = None
    exposure_s: float | None = None
    depth: DepthImage | None = None
    depth_timestamp_ns: int | None = None
    world_from_camera: Float64[np.ndarray, "4 4"] | None = None
    color_jpeg: bytes | None = None
    fisheye: FisheyePictures | None = None
    found_pose: Float64[np.ndarray, "4 4"] | None = None
    composite: bytes | None = None


@dataclass(frozen=True, eq=False, repr=False)
class ViewFrame:
    """The input of one composite.

    Linear camera colour is `decode_lut(response)[color] / exposure_scale`. `exposure_s` is None if it is unknown.
    `depth` is clean and registered to colour; None if the scene gives a model. `board` lets the renderer find the
    board's white paper. `sky_lights` are lights that the sensor node cut from its maps of radiance; the same object
    while they do not change. Renderers compare a frame with later ones, so nothing may overwrite its arrays.
    """

    frame_id: int
    timestamp_ns: int
    color: UInt8[np.ndarray, "h w 3"]
    camera: CameraModel
    response: Float32[np.ndarray, "256 3"] | None = None
    exposure_scale: float = 1.0
    exposure_s: float | None = None
    pose: BoardPose | None = None
    depth: DepthImage | None = None
    board: BoardSpec | None = None
    radiance_map: RadianceMap | None = None
    lamps: tuple[LampPose, ...] = ()
    sky_lights: SkyLights | None = None

    def __repr__(self) -> str:
        has = [name for name in ("pose", "depth", "radiance_map") if getattr(self, name) is not None]
        size = f"{self.camera.width}x{self.camera.height}"
        return f"<ViewFrame {self.frame_id}, {', '.join([size, *has])}>"


def decode_lut(response: Float32[np.ndarray, "256 3"] | None) -> Float32[np.ndarray, "256 3"]:
    """Returns the table camera code -> linear R G B (1.0 = sensor white); None: sRGB (IEC 61966-2-1)."""
    return _srgb_lut() if response is None else response


def linear_color(frame: ViewFrame, color: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Returns a camera-coded picture of a frame in linear camera units (1.0 = sensor white, reference exposure)."""
    lut = decode_lut(frame.response) / np.float32(frame.exposure_scale)
    return np.stack([lut[color[..., channel], channel] for channel in range(3)], axis=-1)


@cache
def _srgb_lut() -> Float32[np.ndarray, "256 3"]:
    code = np.arange(256) / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    table = np.repeat(linear[:, None], 3, axis=1).astype(np.float32)
    table.flags.writeable = False
    return table


def srgb_code(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Returns the code of sRGB (IEC 61966-2-1), 0..1, of linear values; those outside of 0..1 are clipped."""
    clipped = np.clip(linear, 0, 1)
    return np.asarray(np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055))
