"""`doctor` names every camera, or says in one line each what is missing."""

import json

import pytest

from deltalight.sensor_node.cameras import discovery
from deltalight.sensor_node.cameras.driver import Discovery, FoundCamera, MissingSupport
from deltalight.services import doctor
from deltalight.services.doctor import Check
from tests.services.conftest import RunCli


def test_cameras_that_work_that_do_not_and_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Discovery(
        (
            FoundCamera("HD Webcam", "uvc:0", "uvc", "/dev/video0, driver uvcvideo"),
            FoundCamera("OAK 1844", "oak:1844", "oak", "usb_vsc 2.1, unbooted", "no permission: allow it"),
        ),
        (MissingSupport("orbbec", "this OpenCV was built without it", "install another"),),
    )
    monkeypatch.setattr(discovery, "discover", lambda: found)
    monkeypatch.setattr(doctor, "_renderers", lambda: iter(()))
    checks = {check.name: check for check in doctor.examine()}
    assert checks["camera uvc:0"] == Check("camera uvc:0", "ok", "HD Webcam (/dev/video0, driver uvcvideo)")
    assert checks["camera oak:1844"].state == "note"
    assert checks["camera oak:1844"].hint == "no permission: allow it"
    assert checks["Orbbec cameras"].detail == "this OpenCV was built without it"


def test_no_camera_is_no_reason_to_fail_and_json_stays_json(cli: RunCli) -> None:
    done = cli("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(done.stdout)}
    cameras = [check for name, check in checks.items() if "camera" in name]
    assert cameras
    assert all(check["state"] != "missing" for check in cameras)
    assert all(check["hint"] for check in cameras if check["state"] == "note")
    assert all("\n" not in check["detail"] + check["hint"] for check in cameras)
