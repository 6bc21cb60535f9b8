"""Conversion of raw frames to the renderer's input: pose, registered and clean depth. The same live and offline."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, DepthImage, LampPose, SensorFrame, ViewFrame
from deltalight.protocol.poses import require_rigid
from deltalight.protocol.source import Source
from deltalight.sensor_node.board_tracker import BoardTracker
from deltalight.sensor_node.cameras.base import Camera
from deltalight.sensor_node.depth import DepthSettings, clean_depth, estimate_noise_sigma
from deltalight.sensor_node.depth_registration import register_depth
from deltalight.sensor_node.fisheye.light import FisheyeLight
from deltalight.sensor_node.lamp_markers import detect_lamps
from deltalight.sensor_node.markers import BoardDetector


@dataclass(frozen=True)
class _Reference:
    """Data of a whole sequence, from one of its frames."""

    exposure_s: float | None
    noise_sigma_m: float | None
    has_depth: bool

    @classmethod
    def of(cls, frame: SensorFrame) -> Self:
        depth = frame.depth
        noise = None if depth is None else depth.noise_sigma_m or estimate_noise_sigma(depth)
        return cls(frame.exposure_s, noise, depth is not None)


class ViewFrameBuilder:
    """Creates the renderer's input from the frames of one source or camera.

    The pose is the one given with the frame, else the board's, else none. The reference exposure and, if unknown, the
    depth noise are those of the source's first frame, so that a frame's result does not depend on where a run began;
    of a live camera, those of the first frame delivered. A board that rests before a live camera keeps its pose
    (`BoardTracker`); frames of a source are examined one by one.

    Args:
        rig: where the frames come from.
        settings: of the depth clean-up.
        needs_depth: whether the scene's geometry is depth, so that a source without any is an error.
        needs_light: whether the scene's light comes from the node (modes `fisheye` and `tracked`); if not, neither
            `radiance_map` nor `lamps` is filled, which saves their time.

    Raises:
        DeltalightError: depth is needed and the source has none.
    """

    def __init__(
        self,
        rig: Source | Camera,
        settings: DepthSettings | None = None,
        *,
        needs_depth: bool = False,
        needs_light: bool = True,
    ) -> None:
        self._rig, self._settings = rig, settings or DepthSettings()
        self._reference = None if isinstance(rig, Camera) else _Reference.of(rig[0])
        self._detector: BoardDetector | BoardTracker | None = None
        from_rgb = rig.extrinsics.depth_from_rgb
        self._color_from_depth = np.eye(4) if from_rgb is None else np.linalg.inv(from_rgb)
        self._needs_depth, self._needs_light = needs_depth, needs_light
        self._fisheye = FisheyeLight(rig, self._pose_alone)
        self._lamps: tuple[LampPose, ...] = ()
        self._last: tuple[SensorFrame, ViewFrame] | None = None
        if self._reference is not None:
            self._check_depth(self._reference)

    def __call__(self, frame: SensorFrame) -> ViewFrame:
        """Returns the renderer's input for a frame.

        `pose` is None if the board is not visible. `depth` is None if the source has no depth; a single frame without
        has a depth image that is unknown everywhere. Of a picture that is repeated nothing is computed again.

        Raises:
            DeltalightError: depth and colour, or colour and camera, do not fit each other.
        """
        if self._last is None or not _is_repeated(frame, self._last[0]):
            self._last = frame, self._made(frame)
        return replace(self._last[1], frame_id=frame.frame_id, timestamp_ns=frame.timestamp_ns)

    def _made(self, frame: SensorFrame) -> ViewFrame:
        if self._reference is None:
            self._reference = _Reference.of(frame)
            self._check_depth(self._reference)
        pose = self._pose(frame)
        return ViewFrame(
            frame_id=frame.frame_id,
            timestamp_ns=frame.timestamp_ns,
            color=frame.color,
            camera=self._rig.camera,
            response=frame.response,
            exposure_scale=_exposure_scale(frame.exposure_s, self._reference.exposure_s),
            exposure_s=frame.exposure_s or self._reference.exposure_s,
            pose=pose,
            depth=self._depth(frame, self._reference),
            board=self._rig.board,
            radiance_map=self._fisheye.at(frame, pose) if self._needs_light else None,
            lamps=self._find_lamps(frame, pose) if self._needs_light else (),
        )

    @property
    def notes(self) -> list[str]:
        """Sentences about what is missing for light, each said once."""
        return self._fisheye.notes

    def _has_depth(self, reference: _Reference) -> bool:
        return reference.has_depth or self._rig.depth_scale is not None

    def _check_depth(self, reference: _Reference) -> None:
        if self._needs_depth and not self._has_depth(reference):
            raise DeltalightError(
                "the scene's geometry is depth but the source has none; "
                "give depth.txt with its pictures, or a model in the scene's real.geometry."
            )

    def _pose(self, frame: SensorFrame) -> BoardPose | None:
        if frame.world_from_camera is not None:
            return BoardPose(require_rigid(frame.world_from_camera, f"the pose of frame {frame.frame_id}"))
        if self._rig.board is None:
            return None
        if self._detector is None:
            detector = BoardDetector(self._rig.board, self._rig.camera, frame.response)
            self._detector = BoardTracker(detector) if isinstance(self._rig, Camera) else detector
        return self._detector.detect(frame.color)

    def _pose_alone(self, frame: SensorFrame) -> BoardPose | None:
        """Returns the pose of a frame out of sequence, without affecting the detector's memory."""
        detector, self._detector = self._detector, None
        try:
            return self._pose(frame)
        finally:
            self._detector = detector

    def _find_lamps(self, frame: SensorFrame, pose: BoardPose | None) -> tuple[LampPose, ...]:
        if self._rig.board is None or pose is None:
            return ()
        self._lamps = detect_lamps(
            frame.color,
            self._rig.board,
            self._rig.camera,
            frame.response,
            pose.world_from_camera,
            previous=self._lamps,
        )
        return self._lamps

    def _depth(self, frame: SensorFrame, reference: _Reference) -> DepthImage | None:
        camera, depth = self._rig.camera, frame.depth
        if depth is None:
            return _unknown(frame) if self._has_depth(reference) else None
        if depth.noise_sigma_m is None:
            if reference.noise_sigma_m is None:  # the first frame had no depth
                reference = self._reference = replace(reference, noise_sigma_m=estimate_noise_sigma(depth))
            depth = replace(depth, noise_sigma_m=reference.noise_sigma_m)
        if depth.camera is not camera and depth.camera != camera:
            depth = register_depth(depth, camera, self._color_from_depth)
        return clean_depth(depth, frame.color, self._settings)


def _is_repeated(frame: SensorFrame, last: SensorFrame) -> bool:
    """Whether a frame differs from the last in its number and times alone."""
    own = {"frame_id", "timestamp_ns", "depth_timestamp_ns"}
    return all(
        getattr(frame, each.name) is getattr(last, each.name)
        for each in fields(frame)
        if each.name not in own
    )


def _unknown(frame: SensorFrame) -> DepthImage:
    size = frame.color.shape[:2]
    return DepthImage(np.zeros(size, np.float32), np.zeros(size, bool), frame.camera)


def _exposure_scale(exposure_s: float | None, reference_s: float | None) -> float:
    """Returns the frame's exposure over the reference (an unreported exposure is the reference)."""
    return 1.0 if exposure_s is None or reference_s is None else exposure_s / reference_s
