"""OAK cameras of this machine, and what is missing where there are none."""

import os
from pathlib import Path
from typing import Any

from deltalight.sensor_node.cameras.devices import file_text, usb_devices
from deltalight.sensor_node.cameras.driver import Discovery, FoundCamera, MissingSupport
from deltalight.sensor_node.cameras.oak_sdk import INSTALL_HINT, load_depthai, sdk_version

LUXONIS = "03e7"
RULE_FOLDERS = ("etc/udev/rules.d", "lib/udev/rules.d", "usr/lib/udev/rules.d", "run/udev/rules.d")
UDEV_HINT = (
    'allow access: write SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666" into'
    " /etc/udev/rules.d/80-movidius.rules, run `sudo udevadm control --reload-rules` and"
    " `sudo udevadm trigger`, then plug the camera in again"
)


def find_cameras(root: Path) -> Discovery:
    """Lists OAK cameras through the SDK, or, where that is not installed, among the USB devices below `root`."""
    found = tuple(_cameras(root))
    return Discovery(found, () if found else (_nothing_found(root),))


def _cameras(root: Path) -> list[FoundCamera]:
    if sdk_version() is not None:
        return [describe_camera(info) for info in load_depthai().Device.getAllAvailableDevices()]
    return [
        FoundCamera(
            name=file_text(device / "product") or "OAK",
            source="oak",
            kind="oak",
            details=f"USB {LUXONIS} at {device.name}",
            hint=f"depthai is not installed: {INSTALL_HINT}",
        )
        for device in usb_devices(root, LUXONIS)
    ]


def describe_camera(info: Any) -> FoundCamera:  # noqa: ANN401 - a DeviceInfo of the SDK
    """Describes a device that the SDK sees."""
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


def _nothing_found(root: Path) -> MissingSupport:
    version = sdk_version()
    if version is None:
        return MissingSupport("oak", "depthai is not installed", INSTALL_HINT)
    reason, hint = "", "plug one into a USB 3 port, with a USB 3 cable"
    if not (root / "dev/bus/usb").is_dir():
        reason = ": there is no USB bus in /dev/bus/usb"
        hint = "plug one in; in a container, pass the bus in (-v /dev/bus/usb:/dev/bus/usb)"
    elif os.geteuid() != 0 and not _has_udev_rule(root):
        reason, hint = ": no udev rule allows it", UDEV_HINT
    return MissingSupport("oak", f"depthai {version} finds no OAK device{reason}", hint)


def _has_udev_rule(root: Path) -> bool:
    files = [path for folder in RULE_FOLDERS for path in (root / folder).glob("*.rules")]
    return any(LUXONIS in file_text(path).lower() for path in files)
