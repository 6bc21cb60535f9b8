"""USB video (UVC) cameras, and whatever else OpenCV opens as a video, behind the camera interface."""

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.pictures import decode_rgb, is_jpeg
from deltalight.sensor_node.cameras.devices import file_text
from deltalight.sensor_node.cameras.driver import (
    CameraDriver,
    CameraRequest,
    Discovery,
    FoundCamera,
    MissingSupport,
)
from deltalight.sensor_node.cameras.live import (
    DRIVER_BUFFERS,
    CameraFailure,
    LiveCalibration,
    LiveCamera,
    colour_camera,
)
from deltalight.sensor_node.cameras.settings import CameraSettings
from deltalight.sensor_node.cameras.uvc_controls import UvcControls

MJPG = cv2.VideoWriter.fourcc(*"MJPG")
# Automatic exposure and white balance of usual cameras settle within a second.
SETTLE_S = 1.0
# USB loses a packet now and then, which truncates the JPEG; this many in a row are a broken cable.
BROKEN_IN_A_ROW = 10
# Marker of a JPEG's Huffman tables; many cameras omit them, and then few programs can read it.
HUFFMAN_TABLES = b"\xff\xc4"
GROUP_HINT = "run `sudo usermod -aG video $USER`, then log in again"


class UvcCamera(LiveCamera):
    """Colour pictures of a UVC camera, without depth.

    Args:
        device: number or path of the video device (`0`, `/dev/video2`), or a video that OpenCV opens.
        settings: size, rate, exposure and white balance to request.
        calibration: the camera at its capture size, its response, extrinsics, board.
        calibrated: False = a nominal lens is acceptable.

    Raises:
        DeltalightError: the camera is not calibrated.
    """

    def __init__(
        self, device: str, settings: CameraSettings, calibration: LiveCalibration, *, calibrated: bool = True
    ) -> None:
        super().__init__(f"uvc:{device}")
        self.camera = colour_camera(self.source, calibration.camera, settings, calibrated=calibrated)
        self.board, self.extrinsics = calibration.board, calibration.extrinsics
        self._device, self._settings, self._response = device, settings, calibration.response
        self._is_v4l2 = sys.platform == "linux" and (device.isdecimal() or device.startswith("/dev/"))
        self._capture: cv2.VideoCapture | None = None
        self._frames = 0

    def open(self) -> None:
        """Opens the device, locks exposure and white balance as set.

        Raises:
            CameraFailure: it is absent, or another program uses it.
            DeltalightError: it does not support the settings.
        """
        self.close()
        self._interrupted.clear()
        self._capture = capture = self._open_device()
        self._controls = UvcControls(self.source, capture, known=self._is_v4l2)
        try:
            self._ask_for(capture)
            self._require_size(self._take()[0])
            self._set_controls()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Releases the device."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def set_exposure(self, seconds: float) -> None:
        """Locks the exposure to the nearest step of 0.1 ms; it takes effect a few frames later."""
        self._controls.set_exposure(seconds)

    def capture(self) -> SensorFrame:
        """Waits for the next picture."""
        exposure_s = self._controls.exposure_s
        color, jpeg = self._take()
        self._frames += 1
        return SensorFrame(
            frame_id=self._frames - 1,
            timestamp_ns=self.timestamp_ns,
            color=color,
            camera=self.camera,
            response=self._response,
            exposure_s=exposure_s,
            color_jpeg=jpeg,
        )

    def _open_device(self) -> cv2.VideoCapture:
        path = Path(f"/dev/video{self._device}" if self._device.isdecimal() else self._device)
        if self._is_v4l2 and not path.exists():
            raise CameraFailure(f"{self.source}: there is no {path}; `deltalight node --list` names cameras.")
        if self._is_v4l2 and not os.access(path, os.R_OK | os.W_OK):
            raise CameraFailure(
                f"{self.source}: no permission for {path}; add your user to the group `video`."
            )
        backend = cv2.CAP_V4L2 if self._is_v4l2 else cv2.CAP_ANY
        capture = cv2.VideoCapture(int(self._device) if self._device.isdecimal() else self._device, backend)
        if not capture.isOpened():
            raise CameraFailure(
                f"{self.source} cannot be opened; stop the program that uses it, or choose another one from "
                "`deltalight node --list`."
            )
        return capture

    def _ask_for(self, capture: cv2.VideoCapture) -> None:
        wanted = {
            cv2.CAP_PROP_FOURCC: MJPG,  # uncompressed pictures beyond VGA do not fit USB 2 at 30 per second
            cv2.CAP_PROP_FRAME_WIDTH: self.camera.width,
            cv2.CAP_PROP_FRAME_HEIGHT: self.camera.height,
            cv2.CAP_PROP_FPS: self._settings.fps,
            cv2.CAP_PROP_BUFFERSIZE: DRIVER_BUFFERS,
        }
        for prop, value in wanted.items():
            capture.set(prop, value)
        if self._is_v4l2 and int(capture.get(cv2.CAP_PROP_FOURCC)) == MJPG:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # the JPEG as it comes, if it is complete
            if HUFFMAN_TABLES not in self._grab().tobytes():
                capture.set(cv2.CAP_PROP_CONVERT_RGB, 1)

    def _require_size(self, color: UInt8[np.ndarray, "h w 3"]) -> None:
        height, width = color.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise DeltalightError(
                f"{self.source} gives {width}x{height} where {self.camera.width}x{self.camera.height} was asked "
                "for; set width and height to a size it has, and calibrate at that size."
            )

    def _set_controls(self) -> None:
        settings = self._settings
        self._controls.release()
        if settings.exposure_s is not None:
            self._controls.set_exposure(settings.exposure_s)
        if settings.white_balance_k is not None:
            self._controls.set_white_balance(settings.white_balance_k)
        if self._is_v4l2 and settings.lock and None in (settings.exposure_s, settings.white_balance_k):
            for _ in range(round(SETTLE_S * settings.fps)):
                self._grab()
            self.remark = self._controls.keep(
                exposure=settings.exposure_s is None, white_balance=settings.white_balance_k is None
            )

    def _grab(self) -> np.ndarray:
        """Waits for the next picture as the backend gives it, and notes its capture time."""
        capture = self._capture
        if capture is None or not capture.grab():
            raise CameraFailure(f"{self.source} no longer sends pictures; check that it is plugged in.")
        grabbed_ns = time.monotonic_ns()
        given, raw = capture.retrieve()
        # V4L2 reports the time of the buffer by CLOCK_MONOTONIC in ms.
        driver_ns = int(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6) if self._is_v4l2 else grabbed_ns
        self.note_capture(self.clock.plausible(driver_ns, grabbed_ns))
        return np.asarray(raw if given else np.empty(0, np.uint8))

    def _take(self) -> tuple[UInt8[np.ndarray, "h w 3"], bytes | None]:
        """Returns the next complete picture, RGB, and its JPEG if that came."""
        for _ in range(BROKEN_IN_A_ROW):
            picture = decode(self._grab(), self.source)
            if picture is not None:
                return picture
        raise CameraFailure(f"{self.source} sends only broken pictures; use a shorter cable or another port.")


def decode(raw: np.ndarray, name: str) -> tuple[UInt8[np.ndarray, "h w 3"], bytes | None] | None:
    """Returns (RGB, JPEG or None) of OpenCV's output: a BGR picture or a JPEG's bytes; None if it is broken."""
    if raw.ndim == 3 and raw.shape[2] == 3:
        return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BGR2RGB)), None
    data = raw.tobytes()
    data = data[: data.rfind(b"\xff\xd9") + 2]  # the driver's buffer is longer than the JPEG in it
    if not is_jpeg(data):
        return None
    try:
        return decode_rgb(data, name), data
    except DeltalightError:
        return None


def make_camera(request: CameraRequest) -> UvcCamera:
    """The camera that a request names; the first one where it names none."""
    return UvcCamera(
        request.device or "0", request.settings, request.calibration, calibrated=request.calibrated
    )


def find_cameras(root: Path) -> Discovery:
    """Lists the video devices of Linux."""
    found = tuple(_video_devices(root))
    return Discovery(found, () if found else (_nothing_found(root),))


def _video_devices(root: Path) -> Iterator[FoundCamera]:
    """Video devices of Linux, as /sys describes them."""
    entries = (root / "sys/class/video4linux").glob("video*")
    for entry in sorted(entries, key=lambda path: int(path.name.removeprefix("video"))):
        if not _captures(root, entry):
            continue
        number = entry.name.removeprefix("video")
        driver = (entry / "device/driver").resolve().name if (entry / "device/driver").exists() else "?"
        node = root / "dev" / entry.name
        yield FoundCamera(
            name=file_text(entry / "name") or entry.name,
            source=f"uvc:{number}",
            kind="uvc",
            details=f"/dev/{entry.name}, driver {driver}",
            hint=_access_hint(node, f"/dev/{entry.name}"),
        )


def _captures(root: Path, entry: Path) -> bool:
    """Whether a video device gives pictures: USB cameras have a second one that gives metadata."""
    known = root / "run/udev/data" / f"c{file_text(entry / 'dev')}"
    if known.is_file():
        return "ID_V4L_CAPABILITIES=" not in (said := file_text(known)) or ":capture:" in said
    return file_text(entry / "index") in ("", "0")


def _access_hint(node: Path, name: str) -> str:
    if not node.exists():
        return f"{name} does not exist; in a container, pass it in (--device {name})"
    return "" if os.access(node, os.R_OK | os.W_OK) else f"no permission for {name}: {GROUP_HINT}"


def _nothing_found(root: Path) -> MissingSupport:
    if not (root / "sys/class").is_dir():
        return MissingSupport("uvc", "this system does not list its cameras", "try `uvc:0`, `uvc:1`, ...")
    hint = "plug one in, or pass /dev/video0 and so on into the container"
    return MissingSupport("uvc", "no video device in /sys/class/video4linux", hint)


DRIVER = CameraDriver("USB (UVC)", make_camera, find_cameras)
