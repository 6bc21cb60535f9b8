"""Radiance maps for the frames of one source or camera."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.frames import BoardPose, FisheyePictures, RadianceMap, SensorFrame
from deltalight.protocol.source import Source
from deltalight.sensor_node.cameras.base import Camera
from deltalight.sensor_node.fisheye.exposures import reference_exposure
from deltalight.sensor_node.fisheye.radiance import SIZE, radiance_map


class FisheyeLight:
    """Creates one map per set of fish-eye pictures, with the camera's pose when it took them.

    The reference exposure is the longest of the source's first bracket, or of the first one that a camera delivers.

    Args:
        rig: where the frames come from.
        pose_of: finds the pose of one of its frames, without memory of others.
        size: texels per edge of the maps.
    """

    def __init__(
        self, rig: Source | Camera, pose_of: Callable[[SensorFrame], BoardPose | None], size: int = SIZE
    ) -> None:
        self.notes: list[str] = []
        self._rig, self._pose_of, self._size = rig, pose_of, size
        self._reference_s: float | None = None
        self._pictures: FisheyePictures | None = None
        self._map: RadianceMap | None = None

    def at(self, frame: SensorFrame, pose: BoardPose | None) -> RadianceMap | None:
        """Returns the map for a frame whose pose is `pose`: the same object while its pictures are current.

        None without pictures, and until the pose of the fish-eye camera is known; `notes` says what is missing.

        Raises:
            DeltalightError: the pictures do not fit each other or their calibration.
        """
        pictures = frame.fisheye
        if pictures is None:
            return None
        if pictures is not self._pictures:
            self._pictures, self._map = pictures, None
        if self._map is None:
            place = self._place(frame, pictures, pose)
            if place is not None:
                self._map = radiance_map(pictures, place, self._size, self._reference(pictures))
        return self._map

    def _reference(self, pictures: FisheyePictures) -> float | None:
        if self._reference_s is None:
            first = None if isinstance(self._rig, Camera) else self._rig[0].fisheye
            self._reference_s = reference_exposure((first or pictures).exposures_s)
        return self._reference_s

    def _place(
        self, frame: SensorFrame, pictures: FisheyePictures, pose: BoardPose | None
    ) -> Float64[np.ndarray, "4 4"] | None:
        extrinsics = self._rig.extrinsics
        if extrinsics.world_from_fisheye is not None:
            return extrinsics.world_from_fisheye
        if extrinsics.rgb_from_fisheye is None:
            self._note(
                "the fish-eye camera's place is unknown, so its light is not used; give `world_from_fisheye` (a "
                "fixed camera) or `rgb_from_fisheye` (fixed to the colour camera) in calibration/extrinsics.yaml."
            )
            return None
        taken = self._pose_when_taken(frame, pictures) or pose
        return None if taken is None else taken.world_from_camera @ extrinsics.rgb_from_fisheye

    def _pose_when_taken(self, frame: SensorFrame, pictures: FisheyePictures) -> BoardPose | None:
        """Returns the pose of the source's frame nearest in time; a live camera has just taken its pictures."""
        if isinstance(self._rig, Camera):
            return None
        times = np.asarray(self._rig.timestamps_ns)
        nearest = self._rig[int(np.argmin(np.abs(times - pictures.timestamp_ns)))]
        return None if nearest.frame_id == frame.frame_id else self._pose_of(nearest)

    def _note(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)
