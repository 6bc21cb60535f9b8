"""From a raw frame to the renderer's input: pose, registered and clean depth. The same live and offline."""

from typing import Protocol

import numpy as np
from jaxtyping import Float64

from protocol.board import BoardSpec
from protocol.calibration import Extrinsics
from protocol.camera_model import CameraModel
from protocol.errors import DeltalightError
from protocol.frames import BoardPose, DepthImage, SensorFrame, ViewFrame
from protocol.poses import require_rigid
from sensor_node.depth import DepthSettings, clean_depth, estimate_noise_sigma
from sensor_node.depth_registration import register_depth
from sensor_node.markers import BoardDetector


class Rig(Protocol):
    """What is known about the cameras that frames come from: a `Source` or a `Camera`."""

    @property
    def camera(self) -> CameraModel:
        """Colour camera."""

    @property
    def board(self) -> BoardSpec | None:
        """Marker board, if it is described."""

    @property
    def extrinsics(self) -> Extrinsics:
        """Transforms between the sensors."""

    @property
    def depth_scale(self) -> float | None:
        """Metres for each step of the stored depth; None where there is no depth in steps."""

    def __getitem__(self, index: int) -> SensorFrame:
        """Frame by number; 0 gives what the whole sequence is measured by."""


class ViewFrameBuilder:
    """Makes the renderer's input of the frames of one rig.

    The pose is the one given with the frame, else what the board shows, else none. What holds for the whole
    sequence (depth noise where it is unknown, the reference exposure) comes from its first frame, so that
    a frame's result does not depend on where a run began.

    Args:
        rig: source or camera of the frames.
        settings: of the depth clean-up.
        needs_depth: whether the scene's geometry is depth, so that a rig without any is an error.
    """

    def __init__(
        self, rig: Rig, settings: DepthSettings | None = None, *, needs_depth: bool = False
    ) -> None:
        self._rig, self._settings = rig, settings or DepthSettings()
        first = rig[0]
        if needs_depth and first.depth is None and rig.depth_scale is None:
            raise DeltalightError(
                "the scene's geometry is depth but the source has none; "
                "give depth.txt with pictures, or a model in real.geometry."
            )
        self._reference_exposure_s = first.exposure_s
        self._noise_sigma_m = None if first.depth is None else _noise_sigma_m(first.depth)
        self._detector = None if rig.board is None else BoardDetector(rig.board, rig.camera, first.response)
        self._color_from_depth = _color_from_depth(rig.extrinsics)

    def __call__(self, frame: SensorFrame) -> ViewFrame:
        """Return the renderer's input for a frame; `pose` is None where the board is not seen.

        Raises:
            DeltalightError: depth and colour, or colour and camera, do not fit each other.
        """
        return ViewFrame(
            frame_id=frame.frame_id,
            timestamp_ns=frame.timestamp_ns,
            color=frame.color,
            camera=self._rig.camera,
            response=frame.response,
            exposure_scale=self._exposure_scale(frame),
            pose=self._pose(frame),
            depth=None if frame.depth is None else self._clean(frame.depth, frame),
            board=self._rig.board,
        )

    def _exposure_scale(self, frame: SensorFrame) -> float:
        if frame.exposure_s is None or self._reference_exposure_s is None:
            return 1.0
        return frame.exposure_s / self._reference_exposure_s

    def _pose(self, frame: SensorFrame) -> BoardPose | None:
        if frame.world_from_camera is not None:
            return BoardPose(require_rigid(frame.world_from_camera, f"the pose of frame {frame.frame_id}"))
        return None if self._detector is None else self._detector.detect(frame.color)

    def _clean(self, depth: DepthImage, frame: SensorFrame) -> DepthImage:
        if depth.noise_sigma_m is None:
            if self._noise_sigma_m is None:
                self._noise_sigma_m = estimate_noise_sigma(depth)
            depth = DepthImage(depth.depth_m, depth.valid, depth.camera, self._noise_sigma_m)
        if depth.camera is not self._rig.camera and depth.camera != self._rig.camera:
            depth = register_depth(depth, self._rig.camera, self._color_from_depth)
        return clean_depth(depth, frame.color, self._settings)


def _noise_sigma_m(depth: DepthImage) -> float:
    return depth.noise_sigma_m or estimate_noise_sigma(depth)


def _color_from_depth(extrinsics: Extrinsics) -> Float64[np.ndarray, "4 4"]:
    if extrinsics.depth_from_rgb is None:
        return np.eye(4)
    return np.linalg.inv(extrinsics.depth_from_rgb)
