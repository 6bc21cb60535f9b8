"""Cameras found through the files that Linux describes them in, laid out here as a kernel would."""

import os
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.sensor_node.cameras import oak_discovery
from deltalight.sensor_node.cameras.discovery import discover, list_cameras
from deltalight.sensor_node.cameras.driver import FoundCamera
from deltalight.sensor_node.cameras.oak_sdk import INSTALL_HINT, load_depthai, sdk_version
from deltalight.sensor_node.cameras.rgbd import has_backend

ROOT = Path(__file__).resolve().parents[2]


def add_video(root: Path, number: int, name: str, index: int = 0, capabilities: str | None = None) -> None:
    entry = root / f"sys/class/video4linux/video{number}"
    driver = root / "sys/bus/usb/drivers/uvcvideo"
    driver.mkdir(parents=True, exist_ok=True)
    (entry / "device").mkdir(parents=True)
    (entry / "device" / "driver").symlink_to(driver)
    for file, text in (("name", name), ("index", str(index)), ("dev", f"81:{number}")):
        (entry / file).write_text(text + "\n")
    (root / "dev").mkdir(exist_ok=True)
    (root / f"dev/video{number}").touch()
    if capabilities is not None:
        (root / "run/udev/data").mkdir(parents=True, exist_ok=True)
        (root / f"run/udev/data/c81:{number}").write_text(f"E:ID_V4L_CAPABILITIES={capabilities}\n")


def add_usb(root: Path, port: str, vendor: str, product: str) -> None:
    device = root / "sys/bus/usb/devices" / port
    device.mkdir(parents=True)
    for file, text in (("idVendor", vendor), ("idProduct", "0001"), ("product", product)):
        (device / file).write_text(text + "\n")


@pytest.fixture
def no_sdk(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the OAK SDK is not installed."""
    monkeypatch.setattr(oak_discovery, "sdk_version", lambda: None)


@pytest.mark.usefixtures("no_sdk")
def test_video_devices_are_listed_in_order_and_metadata_nodes_are_not(tmp_path: Path) -> None:
    add_video(tmp_path, 10, "Wide Camera")
    add_video(tmp_path, 0, "HD Webcam", capabilities=":capture:")
    add_video(tmp_path, 1, "HD Webcam", capabilities=":")
    add_video(tmp_path, 11, "Wide Camera", index=1)
    found = discover(tmp_path).cameras
    assert [(camera.source, camera.name, camera.hint) for camera in found] == [
        ("uvc:0", "HD Webcam", ""),
        ("uvc:10", "Wide Camera", ""),
    ]
    assert found[0].details == "/dev/video0, driver uvcvideo"
    assert found[0].as_dict()["kind"] == "uvc"


@pytest.mark.usefixtures("no_sdk")
def test_what_keeps_a_camera_from_being_opened_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_video(tmp_path, 0, "HD Webcam")
    (tmp_path / "dev/video0").unlink()
    assert "in a container, pass it in" in discover(tmp_path).cameras[0].hint
    (tmp_path / "dev/video0").touch()
    monkeypatch.setattr(os, "access", lambda *_: False)
    (camera,) = discover(tmp_path).cameras
    assert camera.hint.startswith("no permission for /dev/video0: run `sudo usermod -aG video")


@pytest.mark.usefixtures("no_sdk")
def test_usb_devices_of_known_makers_are_named_with_what_they_need(tmp_path: Path) -> None:
    add_usb(tmp_path, "1-2", "2bc5", "Astra Pro")
    add_usb(tmp_path, "1-4", "2bc5", "Astra Mini")
    add_usb(tmp_path, "2-1", "1d27", "PrimeSense Device")
    add_usb(tmp_path, "3-1", "03e7", "Movidius MyriadX")
    add_usb(tmp_path, "3-2", "046d", "Keyboard")
    (tmp_path / "sys/bus/usb/devices/usb1").mkdir()
    found = {camera.source: camera for camera in discover(tmp_path).cameras}
    assert list(found) == ["oak", "orbbec:0", "orbbec:1", "openni2:0"]
    assert found["oak"].hint == f"depthai is not installed: {INSTALL_HINT}"
    assert found["orbbec:1"].name == "Astra Mini"
    assert ("WITH_OPENNI2=ON" in found["openni2:0"].hint) is not has_backend("openni2")


def test_what_is_missing_is_said_for_each_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak_discovery, "sdk_version", lambda: None)
    missing = {kind.kind: kind for kind in discover(tmp_path).missing}
    assert "does not list" in missing["uvc"].details
    assert missing["oak"].hint == INSTALL_HINT
    (tmp_path / "sys/class").mkdir(parents=True)
    missing = {kind.kind: kind for kind in discover(tmp_path).missing}
    assert "no video device" in missing["uvc"].details
    add_video(tmp_path, 0, "HD Webcam")
    assert "uvc" not in {kind.kind for kind in discover(tmp_path).missing}


def test_the_version_that_is_asked_for_is_that_of_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert install_command(*project["optional-dependencies"]["oak"]) == INSTALL_HINT
    monkeypatch.setitem(sys.modules, "depthai", SimpleNamespace(__version__="3.9.1"))
    with pytest.raises(DeltalightError, match=r"depthai 3\.9\.1 is too old; run "):
        load_depthai()


@pytest.mark.skipif(sdk_version() is None, reason="the OAK SDK is not installed")
class TestWithTheSdk:
    def test_a_missing_bus_and_a_missing_rule_are_told_apart(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if load_depthai().Device.getAllAvailableDevices():
            pytest.skip("an OAK is plugged in")

        def oak() -> tuple[str, str]:
            (kind,) = (kind for kind in discover(tmp_path).missing if kind.kind == "oak")
            assert f"depthai {sdk_version()}" in kind.details
            return kind.details, kind.hint

        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        assert "no USB bus" in oak()[0]
        (tmp_path / "dev/bus/usb").mkdir(parents=True)
        details, hint = oak()
        assert "no udev rule" in details
        assert 'ATTRS{idVendor}=="03e7"' in hint
        (tmp_path / "etc/udev/rules.d").mkdir(parents=True)
        (tmp_path / "etc/udev/rules.d/80-movidius.rules").write_text('ATTRS{idVendor}=="03e7", MODE="0666"\n')
        assert "USB 3" in oak()[1]

    @pytest.mark.parametrize(
        ("state", "status", "hint"),
        [
            ("X_LINK_UNBOOTED", "X_LINK_SUCCESS", ""),
            ("X_LINK_UNBOOTED", "X_LINK_INSUFFICIENT_PERMISSIONS", "udev"),
            ("X_LINK_BOOTED", "X_LINK_SUCCESS", "in use"),
        ],
    )
    def test_devices_of_the_sdk_are_described(self, state: str, status: str, hint: str) -> None:
        dai = load_depthai()
        info = dai.DeviceInfo(
            "2.1",
            "14442C10D13EABCE00",
            getattr(dai.XLinkDeviceState, state),
            dai.XLinkProtocol.X_LINK_USB_VSC,
            dai.XLinkPlatform.X_LINK_MYRIAD_X,
            getattr(dai.XLinkError_t, status),
        )
        found = oak_discovery.describe_camera(info)
        assert found == FoundCamera(
            name="OAK 14442C10D13EABCE00",
            source="oak:14442C10D13EABCE00",
            kind="oak",
            details=f"usb_vsc 2.1, {state.removeprefix('X_LINK_').lower()}",
            hint=found.hint,
        )
        assert hint in found.hint
        assert bool(hint) == bool(found.hint)


def test_this_machine_can_be_searched() -> None:
    assert all(isinstance(camera, FoundCamera) for camera in list_cameras())
