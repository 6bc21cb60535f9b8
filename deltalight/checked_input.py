"""Checks of the frames and scenes that a program passes to a renderer: what it made itself may be anything."""

import math
import operator
from typing import SupportsFloat, SupportsIndex

import numpy as np

from deltalight.protocol.array_checks import kind_of, misfit
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.protocol.method_names import require_method
from deltalight.protocol.poses import require_rigid
from deltalight.protocol.scene import SceneDocument
from deltalight.scene import Scene


def require_method_name(method: object) -> str:
    """Returns the name of a method.

    Raises:
        DeltalightError: it is no name, or there is no such method.
    """
    if not isinstance(method, str):
        raise DeltalightError(
            f'The name of a method is needed and {kind_of(method)} was given; write `method="exact"`, for example.'
        )
    return require_method(method)


def require_device(device: object) -> int:
    """Returns the number of an EGL device, which may be one of numpy's.

    Raises:
        DeltalightError: it is no number from 0 on.
    """
    number = operator.index(device) if isinstance(device, SupportsIndex) else -1
    if number < 0 or isinstance(device, bool):
        raise DeltalightError(
            f"The device {device!r} is not possible; give a number from 0 on, as `deltalight doctor` lists them, or"
            " None for the driver's first."
        )
    return number


def require_document(scene: object) -> SceneDocument:
    """Returns the document of a scene.

    Raises:
        DeltalightError: it is neither a scene nor a scene document.
    """
    document = scene.document if isinstance(scene, Scene) else scene
    if not isinstance(document, SceneDocument):
        raise DeltalightError(
            f"A scene is needed and {kind_of(document)} was given; load one with `Scene.load`, or take `Scene()`."
        )
    return document


def require_frames(frames: object) -> list[ViewFrame]:
    """Returns frames as a list: one for each camera.

    Raises:
        DeltalightError: they are no frames, or one has arrays that do not fit its camera, or no possible pose.
    """
    if isinstance(frames, ViewFrame) or not hasattr(frames, "__iter__"):
        raise DeltalightError(
            f"A list with a frame of each camera is needed and {kind_of(frames)} was given; write `[frame]`."
        )
    return [_require_frame(frame) for frame in frames]


def _require_frame(frame: object) -> ViewFrame:
    if not isinstance(frame, ViewFrame):
        raise DeltalightError(
            f"A frame is needed and {kind_of(frame)} was given; take one of `deltalight.open(...)`."
        )
    size = _size(frame.camera, "camera")
    _require_array(frame.color, "color", np.uint8, (*size, 3))
    _require_response(frame.response)
    scale = float(frame.exposure_scale) if isinstance(frame.exposure_scale, SupportsFloat) else math.nan
    if not 0 < scale < math.inf:
        raise DeltalightError(f"The frame's exposure_scale is {frame.exposure_scale}; give a number above 0.")
    for name in ("frame_id", "timestamp_ns"):
        if not isinstance(number := getattr(frame, name), SupportsIndex):
            raise DeltalightError(f"The frame's {name} is {number!r}; give a whole number.")
    _require_depth(frame.depth)
    _require_pose(frame.pose)
    return frame


def _require_response(response: object) -> None:
    if response is None:
        return
    _require_array(response, "response", np.floating, (256, 3))
    if not np.isfinite(np.asarray(response)).all():
        raise DeltalightError("The frame's response holds values that are not finite; give linear light.")


def _require_depth(depth: object) -> None:
    if depth is None:
        return
    if not isinstance(depth, DepthImage):
        raise DeltalightError(f"The frame's depth is {kind_of(depth)}; give a DepthImage.")
    size = _size(depth.camera, "depth.camera")
    _require_array(depth.depth_m, "depth.depth_m", np.floating, size)
    _require_array(depth.valid, "depth.valid", np.bool_, size)


def _require_pose(pose: object) -> None:
    if pose is None:
        return
    if not isinstance(pose, BoardPose):
        raise DeltalightError(f"The frame's pose is {kind_of(pose)}; write `BoardPose(world_from_camera)`.")
    require_rigid(pose.world_from_camera, "the frame's pose")


def _size(camera: object, name: str) -> tuple[int, int]:
    if not isinstance(camera, CameraModel):
        raise DeltalightError(f"The frame's {name} is {kind_of(camera)}; give a CameraModel.")
    return camera.height, camera.width


def _require_array(array: object, name: str, kind: type[np.generic], shape: tuple[int, ...]) -> None:
    wrong = misfit(array, kind, shape)
    if wrong is not None:
        raise DeltalightError(f"The frame's {name} {wrong}; convert it.")
