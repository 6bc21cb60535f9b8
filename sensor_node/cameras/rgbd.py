"""RGB-D cameras supported by OpenCV: OpenNI 2 (Asus Xtion, PrimeSense, Orbbec Astra) and Orbbec over UVC."""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.pictures import depth_from_steps
from deltalight.sensor_node.cameras.devices import file_text, usb_devices
from deltalight.sensor_node.cameras.driver import (
    CameraDriver,
    CameraRequest,
    Discovery,
    FoundCamera,
    MissingSupport,
)
from deltalight.sensor_node.cameras.live import CameraFailure, LiveCalibration, LiveCamera, colour_camera
from deltalight.sensor_node.cameras.settings import CameraSettings

Kind = Literal["openni2", "orbbec"]


@dataclass(frozen=True)
class _Backend:
    """OpenCV's numbers for one kind of camera, the USB vendor of such cameras, what to do where OpenCV lacks it."""

    number: int
    color: int
    depth: int
    vendor: str
    advice: str


BACKENDS: dict[Kind, _Backend] = {
    "openni2": _Backend(
        cv2.CAP_OPENNI2,
        cv2.CAP_OPENNI_BGR_IMAGE,
        cv2.CAP_OPENNI_DEPTH_MAP,
        "1d27",  # PrimeSense, also Kinect-like
        "install an OpenCV built with WITH_OPENNI2=ON",
    ),
    "orbbec": _Backend(
        cv2.CAP_OBSENSOR,
        cv2.CAP_OBSENSOR_BGR_IMAGE,
        cv2.CAP_OBSENSOR_DEPTH_MAP,
        "2bc5",
        "run pip install 'opencv-contrib-python-headless<5', as packages of OpenCV 4 have it",
    ),
}


def has_backend(kind: Kind) -> bool:
    """Whether the installed OpenCV supports a kind of camera."""
    return bool(cv2.videoio_registry.hasBackend(BACKENDS[kind].number))


def backend_hint(kind: Kind) -> str:
    """Returns what to do if it does not."""
    return f"for such a camera, {BACKENDS[kind].advice}"


class RgbdCamera(LiveCamera):
    """Colour and depth of camera `number` of a kind; depth is registered to colour unless depth.yaml says otherwise.

    Raises:
        DeltalightError: this OpenCV cannot read such a camera, or it is not calibrated.
    """

    def __init__(
        self,
        kind: Kind,
        number: int,
        settings: CameraSettings,
        calibration: LiveCalibration,
        *,
        calibrated: bool = True,
    ) -> None:
        super().__init__(f"{kind}:{number}")
        if not has_backend(kind):
            raise DeltalightError(
                f"{self.source}: this OpenCV was built without {kind} cameras; {backend_hint(kind)}."
            )
        if settings.exposure_s is not None or settings.white_balance_k is not None:
            raise DeltalightError(f"{self.source} has no exposure or white balance to set; leave them out.")
        self.camera = colour_camera(self.source, calibration.camera, settings, calibrated=calibrated)
        self.board, self.extrinsics = calibration.board, calibration.extrinsics
        self.depth_scale = calibration.depth_scale
        self._kind, self._number, self._calibration = kind, number, calibration
        self._capture = cv2.VideoCapture()
        self._frames = 0

    def open(self) -> None:
        """Opens the device and requests depth registered to colour.

        Raises:
            CameraFailure: it is absent, or another program uses it.
        """
        self._interrupted.clear()
        if not self._capture.open(self._number, BACKENDS[self._kind].number):
            raise CameraFailure(f"{self.source} cannot be opened; see `deltalight node --list`.")
        if self._calibration.depth_camera is None:
            self._capture.set(cv2.CAP_PROP_OPENNI_REGISTRATION, 1)

    def close(self) -> None:
        """Releases the device."""
        self._capture.release()

    def capture(self) -> SensorFrame:
        """Waits for the next pair of pictures."""
        if not self._capture.grab():
            raise CameraFailure(f"{self.source} no longer sends pictures; check that it is plugged in.")
        self.note_capture(time.monotonic_ns())
        backend = BACKENDS[self._kind]
        has_color, color = self._capture.retrieve(flag=backend.color)
        has_depth, steps = self._capture.retrieve(flag=backend.depth)
        if not has_color:
            raise CameraFailure(f"{self.source} gives no colour pictures; plug it into another USB port.")
        self._frames += 1
        return self._frame(np.asarray(color), np.asarray(steps) if has_depth else None)

    def _frame(self, bgr: UInt8[np.ndarray, "h w 3"], steps: UInt16[np.ndarray, "h w"] | None) -> SensorFrame:
        known, camera = self._calibration, self.camera
        if bgr.shape[1::-1] != (camera.width, camera.height):
            raise DeltalightError(
                f"{self.source} gives {bgr.shape[1]}x{bgr.shape[0]} but is calibrated for "
                f"{camera.width}x{camera.height}; calibrate at that size."
            )
        stamp_ns = self.timestamp_ns
        depth_camera = known.depth_camera or camera
        depth = (
            None
            if steps is None
            else depth_from_steps(steps, known.depth_scale, depth_camera, known.depth_noise_m)
        )
        return SensorFrame(
            frame_id=self._frames - 1,
            timestamp_ns=stamp_ns,
            color=np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)),
            camera=camera,
            response=known.response,
            depth=depth,
            depth_timestamp_ns=None if depth is None else stamp_ns,
        )


def make_camera(kind: Kind, request: CameraRequest) -> RgbdCamera:
    """The camera that a request names by its number.

    Raises:
        DeltalightError: it names no number.
    """
    number = request.device or "0"
    if not number.isdecimal():
        raise DeltalightError(f"{request.source} names no camera; write a number after the colon, such as 0.")
    return RgbdCamera(kind, int(number), request.settings, request.calibration, calibrated=request.calibrated)


def find_cameras(kind: Kind, root: Path) -> Discovery:
    """Lists the USB devices of the vendor."""
    has_support = has_backend(kind)
    found = tuple(
        FoundCamera(
            name=file_text(device / "product") or kind,
            source=f"{kind}:{number}",
            kind=kind,
            details=f"USB {file_text(device / 'idVendor')}:{file_text(device / 'idProduct')} at {device.name}",
            hint="" if has_support else backend_hint(kind),
        )
        for number, device in enumerate(usb_devices(root, BACKENDS[kind].vendor))
    )
    missing = MissingSupport(kind, "this OpenCV was built without it", backend_hint(kind))
    return Discovery(found, () if has_support else (missing,))


OPENNI2 = CameraDriver("OpenNI 2", partial(make_camera, "openni2"), partial(find_cameras, "openni2"))
ORBBEC = CameraDriver("Orbbec", partial(make_camera, "orbbec"), partial(find_cameras, "orbbec"))
