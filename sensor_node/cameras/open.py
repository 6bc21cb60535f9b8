"""Opening cameras by their names: `synthetic`, a folder, an .mcap file, `uvc:0`, `oak`, ..."""

from pathlib import Path

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.dataset_fisheye import load_fisheye_calibration
from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import exists
from deltalight.protocol.fisheye_lens import FisheyeCalibration, load_fisheye_yaml
from deltalight.protocol.source import is_recording_name, open_source
from deltalight.sensor_node.cameras.base import Camera
from deltalight.sensor_node.cameras.driver import CameraRequest
from deltalight.sensor_node.cameras.drivers import SYNTHETIC, driver_plugins, load_driver
from deltalight.sensor_node.cameras.fisheye_capture import FisheyeCapture
from deltalight.sensor_node.cameras.live import load_calibration
from deltalight.sensor_node.cameras.reconnect import ReconnectingCamera
from deltalight.sensor_node.cameras.replay import ReplayCamera
from deltalight.sensor_node.cameras.settings import CameraSettings, FisheyeSettings
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_camera

_DEFAULTS = CameraSettings()


def is_live(source: str) -> bool:
    """Whether `source` names a camera that captures now (`uvc:0`), not a replay or `synthetic`."""
    return _kind(source) in [plugin.name for plugin in driver_plugins()]


def open_camera(
    source: str,
    settings: CameraSettings = _DEFAULTS,
    *,
    board: BoardSpec | None = None,
    calibrated: bool = True,
    depth: bool = True,
) -> Camera:
    """Returns the camera that `source` names, not opened yet (it is a context manager).

    Args:
        source: `synthetic`, a dataset folder, an .mcap recording, or a live camera: `uvc:0`,
            `uvc:/dev/video2`, `oak`, `oak:<device id>`, `openni2:0`, `orbbec:0`, or a plugin's name.
        settings: how to replay or capture.
        board: takes the place of the board that the source describes.
        calibrated: False gives a live camera without calibration a nominal lens, so that it can be calibrated.
        depth: False asks an OAK for colour only, as the sensor sees it.

    Raises:
        DeltalightError: there is no such source, it cannot be read, or its calibration is missing.
    """
    if source == SYNTHETIC:
        return _synthetic(settings, board)
    if is_live(source):
        return _open_live(source, settings, board, calibrated=calibrated, depth=depth)
    if not source:
        raise DeltalightError("the path is empty; name a dataset folder, an .mcap recording or a camera.")
    path = Path(source)
    if not exists(path) and not is_recording_name(source) and len(path.parts) < 2:
        raise _unknown(source)
    return ReplayCamera(open_source(path, board), realtime=settings.realtime, loop=settings.loop)


def _synthetic(settings: CameraSettings, board: BoardSpec | None) -> SyntheticCamera:
    usual = default_camera()
    return SyntheticCamera(
        board,
        usual.resized(settings.width or usual.width, settings.height or usual.height),
        period_ns=round(1e9 / settings.fps),
        realtime=settings.realtime,
        loop=settings.loop,
    )


def _open_live(
    source: str, settings: CameraSettings, board: BoardSpec | None, *, calibrated: bool, depth: bool
) -> Camera:
    plugin, driver = load_driver(_kind(source))
    calibration = load_calibration(settings.calibration, board)
    with plugin.blamed():
        inner = driver.make(CameraRequest(source, settings, calibration, calibrated=calibrated, depth=depth))
    if not isinstance(inner, Camera):
        raise plugin.fault("its driver makes no Camera")
    return ReconnectingCamera(inner, source, stall_s=settings.stall_s)


def _kind(source: str) -> str:
    return source.partition(":")[0]


def open_fisheye(settings: FisheyeSettings, calibration: Path | None = None) -> FisheyeCapture:
    """Returns the camera that sees the light, not opened yet (it is a context manager).

    `calibration` is the folder to search for fisheye.yaml if the settings name none.

    Raises:
        DeltalightError: there is no such source, or its fisheye.yaml is missing or wrong.
    """
    known = _fisheye_calibration(settings.source, settings.camera.calibration or calibration)
    return FisheyeCapture(
        open_camera(settings.source, _of_fisheye(settings.camera, known), calibrated=False, depth=False),
        known,
        exposures_s=settings.exposures_s,
        settle_frames=settings.settle_frames,
    )


def _fisheye_calibration(source: str, folder: Path | None) -> FisheyeCalibration | None:
    if folder is not None and (folder / "calibration").is_dir():
        known = load_fisheye_calibration(folder)
    elif folder is not None and (folder / "fisheye.yaml").is_file():
        known = load_fisheye_yaml(folder / "fisheye.yaml")
    else:
        known = None
    if known is None and is_live(source):
        raise DeltalightError(
            f"the fish-eye camera {source} has no calibration; run `deltalight calibrate fisheye` and name the "
            "folder that holds fisheye.yaml."
        )
    return known


def _of_fisheye(settings: CameraSettings, known: FisheyeCalibration | None) -> CameraSettings:
    """Returns settings with the lens's size; the folder's rgb.yaml belongs to another camera."""
    size = {} if known is None else {"width": known.lens.width, "height": known.lens.height}
    chosen = settings.model_dump(include={"width", "height"}, exclude_none=True)
    return settings.model_copy(update={"calibration": None, **size, **chosen})


def _unknown(source: str) -> DeltalightError:
    head, _, rest = source.partition(":")
    hint = nearest(head, (SYNTHETIC, *(plugin.name for plugin in driver_plugins())))
    if hint is None:
        advice = "give a dataset folder, an .mcap recording, `synthetic`, or a camera such as `uvc:0`"
    else:
        advice = f"the nearest is `{hint}{':' + rest if rest and hint != SYNTHETIC else ''}`"
    return DeltalightError(
        f"there is no file, folder or camera `{source}`; {advice} (`deltalight node --list` names cameras)."
    )
