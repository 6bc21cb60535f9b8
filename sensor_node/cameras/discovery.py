"""Discovery of this machine's cameras without opening one, and of what other kinds still need."""

import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from sensor_node.cameras.oak_sdk import INSTALL_HINT, load_depthai, sdk_version
from sensor_node.cameras.rgbd import Kind as RgbdKind
from sensor_node.cameras.rgbd import backend_hint, has_backend

Kind = Literal["uvc", "oak", "openni2", "orbbec"]

LUXONIS = "03e7"
# USB vendors of RGB-D cameras that OpenCV can read: PrimeSense (also Kinect-like, by OpenNI2) and Orbbec.
RGBD_VENDORS: dict[str, RgbdKind] = {"1d27": "openni2", "2bc5": "orbbec"}
RULE_FOLDERS = ("etc/udev/rules.d", "lib/udev/rules.d", "usr/lib/udev/rules.d", "run/udev/rules.d")
UDEV_HINT = (
    'allow access: write SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666" into'
    " /etc/udev/rules.d/80-movidius.rules, run `sudo udevadm control --reload-rules` and"
    " `sudo udevadm trigger`, then plug the camera in again"
)
GROUP_HINT = "run `sudo usermod -aG video $USER`, then log in again"


@dataclass(frozen=True)
class FoundCamera:
    """A camera that was found; `source` opens it, `hint` says what prevents opening it."""

    name: str
    source: str
    kind: Kind
    details: str
    hint: str = ""

    def as_dict(self) -> dict[str, str]:
        """Return the camera as plain data."""
        return asdict(self)


@dataclass(frozen=True)
class MissingSupport:
    """Why no camera of some kind was found, and what to do about it."""

    kind: Kind
    details: str
    hint: str


@dataclass(frozen=True)
class Discovery:
    """The cameras that were found, and the kinds that could not be."""

    cameras: tuple[FoundCamera, ...]
    missing: tuple[MissingSupport, ...]


def list_cameras() -> list[FoundCamera]:
    """Return the live cameras of this machine; takes about a second where the OAK SDK is installed."""
    return list(discover().cameras)


def discover(root: Path = Path("/")) -> Discovery:
    """Find cameras in the file system below `root` and through the OAK SDK."""
    uvc, oak, rgbd = list(_uvc_cameras(root)), _oak_cameras(root), list(_rgbd_cameras(root))
    missing = [*_missing_uvc(root, uvc), *_missing_oak(root, oak), *_missing_rgbd()]
    return Discovery((*oak, *uvc, *rgbd), tuple(missing))


def _uvc_cameras(root: Path) -> Iterator[FoundCamera]:
    """Yield the video devices of Linux, as /sys describes them."""
    entries = (root / "sys/class/video4linux").glob("video*")
    for entry in sorted(entries, key=lambda path: int(path.name.removeprefix("video"))):
        if not _captures(root, entry):
            continue
        number = entry.name.removeprefix("video")
        driver = (entry / "device/driver").resolve().name if (entry / "device/driver").exists() else "?"
        node = root / "dev" / entry.name
        yield FoundCamera(
            name=_text(entry / "name") or entry.name,
            source=f"uvc:{number}",
            kind="uvc",
            details=f"/dev/{entry.name}, driver {driver}",
            hint=_access_hint(node, f"/dev/{entry.name}"),
        )


def _captures(root: Path, entry: Path) -> bool:
    """Whether a video device gives pictures: USB cameras have a second one for metadata."""
    known = root / "run/udev/data" / f"c{_text(entry / 'dev')}"
    if known.is_file():
        return "ID_V4L_CAPABILITIES=" not in (properties := _text(known)) or ":capture:" in properties
    return _text(entry / "index") in ("", "0")


def _access_hint(node: Path, name: str) -> str:
    if not node.exists():
        return f"{name} does not exist; in a container, pass it in (--device {name})"
    return "" if os.access(node, os.R_OK | os.W_OK) else f"no permission for {name}: {GROUP_HINT}"


def _rgbd_cameras(root: Path) -> Iterator[FoundCamera]:
    counts: dict[RgbdKind, int] = {}
    for device in _usb_devices(root):
        kind = RGBD_VENDORS.get(_text(device / "idVendor"))
        if kind is None:
            continue
        number = counts[kind] = counts.get(kind, -1) + 1
        yield FoundCamera(
            name=_text(device / "product") or kind,
            source=f"{kind}:{number}",
            kind=kind,
            details=f"USB {_text(device / 'idVendor')}:{_text(device / 'idProduct')} at {device.name}",
            hint="" if has_backend(kind) else backend_hint(kind),
        )


def _oak_cameras(root: Path) -> list[FoundCamera]:
    if sdk_version() is not None:
        return [_oak_camera(info) for info in load_depthai().Device.getAllAvailableDevices()]
    return [
        FoundCamera(
            name=_text(device / "product") or "OAK",
            source="oak",
            kind="oak",
            details=f"USB {LUXONIS} at {device.name}",
            hint=f"depthai is not installed: {INSTALL_HINT}",
        )
        for device in _usb_devices(root)
        if _text(device / "idVendor") == LUXONIS
    ]


def _oak_camera(info: Any) -> FoundCamera:  # noqa: ANN401 - a DeviceInfo of the SDK
    """Describe a device that the SDK sees."""
    dai = load_depthai()
    refused = info.status == dai.XLinkError_t.X_LINK_INSUFFICIENT_PERMISSIONS
    is_booted = info.state == dai.XLinkDeviceState.X_LINK_BOOTED
    hint = f"no permission: {UDEV_HINT}" if refused else "in use by another program" if is_booted else ""
    link, state = (value.name.removeprefix("X_LINK_").lower() for value in (info.protocol, info.state))
    return FoundCamera(
        name=f"OAK {info.deviceId}" if info.deviceId else "OAK",
        source=f"oak:{info.deviceId or info.name}",
        kind="oak",
        details=f"{link} {info.name}, {state}",
        hint=hint,
    )


def _missing_uvc(root: Path, found: list[FoundCamera]) -> Iterator[MissingSupport]:
    if found:
        return
    if not (root / "sys/class").is_dir():
        yield MissingSupport("uvc", "this system does not list its cameras", "try `uvc:0`, `uvc:1`, ...")
    else:
        hint = "plug one in, or pass /dev/video0 and so on into the container"
        yield MissingSupport("uvc", "no video device in /sys/class/video4linux", hint)


def _missing_oak(root: Path, found: list[FoundCamera]) -> Iterator[MissingSupport]:
    version = sdk_version()
    if found:
        return
    if version is None:
        yield MissingSupport("oak", "depthai is not installed", INSTALL_HINT)
        return
    reason, hint = "", "plug one into a USB 3 port, with a USB 3 cable"
    if not (root / "dev/bus/usb").is_dir():
        reason = ": there is no USB bus in /dev/bus/usb"
        hint = "plug one in; in a container, pass the bus in (-v /dev/bus/usb:/dev/bus/usb)"
    elif os.geteuid() != 0 and not _has_udev_rule(root):
        reason, hint = ": no udev rule allows it", UDEV_HINT
    yield MissingSupport("oak", f"depthai {version} finds no OAK device{reason}", hint)


def _has_udev_rule(root: Path) -> bool:
    files = [path for folder in RULE_FOLDERS for path in (root / folder).glob("*.rules")]
    return any(LUXONIS in _text(path).lower() for path in files)


def _missing_rgbd() -> Iterator[MissingSupport]:
    for kind in dict.fromkeys(RGBD_VENDORS.values()):
        if not has_backend(kind):
            yield MissingSupport(kind, "this OpenCV was built without it", backend_hint(kind))


def _usb_devices(root: Path) -> Iterator[Path]:
    folder = root / "sys/bus/usb/devices"
    yield from (path for path in sorted(folder.glob("*")) if (path / "idVendor").is_file())


def _text(path: Path) -> str:
    """Return the content of a small file, empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
