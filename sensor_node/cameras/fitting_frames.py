"""Checks of the frames of live cameras: a plugin's driver may make anything."""

import numpy as np

from deltalight.protocol.array_checks import kind_of, misfit
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame


def require_fitting(frame: object, name: str) -> None:
    """Refuses a frame whose pictures do not fit their cameras; `name` is the camera's in sentences.

    Raises:
        DeltalightError: it is no frame, or an array has another shape or type.
    """
    if not isinstance(frame, SensorFrame):
        raise DeltalightError(f"the driver of {name} gives {kind_of(frame)}, not a SensorFrame; correct it.")
    size = _size(frame.camera, name)
    _require_array(frame.color, np.uint8, (*size, 3), f"colour of {name}")
    if frame.depth is not None:
        size = _size(frame.depth.camera, f"the depth of {name}")
        _require_array(frame.depth.depth_m, np.floating, size, f"depth of {name}")
        _require_array(frame.depth.valid, np.bool_, size, f"mask of depth of {name}")


def _size(camera: object, name: str) -> tuple[int, int]:
    if not isinstance(camera, CameraModel):
        raise DeltalightError(
            f"the lens of {name} is {kind_of(camera)}, not a CameraModel; correct its driver."
        )
    return camera.height, camera.width


def _require_array(array: object, kind: type[np.generic], shape: tuple[int, ...], name: str) -> None:
    wrong = misfit(array, kind, shape)
    if wrong is not None:
        raise DeltalightError(f"the {name} {wrong}; correct its driver.")
