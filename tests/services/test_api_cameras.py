"""Several cameras in one room, by REST: each has its own pictures, and requests name whose they mean."""

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import websockets
from websockets.sync.client import ClientConnection

from deltalight.services.api.live_hub import LiveHub
from deltalight.services.client import ApiError, Client
from deltalight.services.h264 import why_unavailable
from deltalight.services.live_message import LiveHeader, unpack
from tests.services.api_samples import sentence
from tests.services.camera_samples import SHADES, CameraApi, camera_api, cameras_message, grey
from tests.services.live_samples import composite, event_socket, live_socket, next_event
from tests.services.render_server_samples import NOWHERE
from tests.services.test_api_live import follow
from tests.services.test_api_scenes import wait_for

THERE = "there is no camera 'middle'; there are left, right."


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CameraApi]:
    with camera_api(tmp_path_factory.mktemp("data")) as api:
        yield api


@pytest.fixture
def api(running: CameraApi) -> Iterator[CameraApi]:
    """With both cameras live."""
    wait_for(lambda: statuses(running) == {"left": "live", "right": "live"})
    yield running
    running.room.statuses = dict.fromkeys(SHADES, "live")
    wait_for(lambda: statuses(running) == {"left": "live", "right": "live"})


def statuses(api: CameraApi) -> dict[str, str]:
    return {each["name"]: each["status"] for each in api.client.get("/state").json()["cameras"]}


def state_of_right(api: CameraApi) -> dict[str, Any]:
    right: dict[str, Any] = api.client.get("/state").json()["cameras"][1]
    return right


def next_of(socket: ClientConnection, node: str) -> LiveHeader:
    """The header of the first picture of a camera, whose shade is checked."""
    before = None
    for _ in range(200):
        message = socket.recv(timeout=10)
        socket.send("ack")
        assert isinstance(message, bytes)
        before, jpeg = unpack(message, before)
        if before.node == node:
            assert grey(jpeg) == SHADES[node]
            return before
    pytest.fail(f"no picture of {node} came")


def test_a_picture_wakes_only_those_who_see_its_camera() -> None:
    async def woken(hub: LiveHub, node: str) -> set[str | None]:
        arrivals = {camera: hub.arrival(camera) for camera in ("left", "right", None)}
        hub.publish(composite(1).model_copy(update={"node": node}), [b""], "")
        await asyncio.sleep(0.01)
        return {camera for camera, arrival in arrivals.items() if arrival.is_set()}

    async def wake_all() -> None:
        hub = LiveHub()
        hub.note_cameras(cameras_message({"left": "live", "right": "live"}))
        hub.attach(asyncio.get_running_loop())
        assert await woken(hub, "right") == {"right", None}, "the first that lives is not there yet"
        assert await woken(hub, "left") == {"left", None}
        assert await woken(hub, "right") == {"right"}

    asyncio.run(wake_all())


def test_each_camera_has_its_picture_and_the_first_is_the_default(api: CameraApi) -> None:
    assert api.shade() == api.shade(camera="left") == SHADES["left"]
    assert api.shade(camera="right", view="composite") == SHADES["right"]
    with api.client.stream("GET", "/live.mjpg", params={"camera": "right"}) as answer:
        part = next(answer.iter_bytes())
    assert grey(part[part.index(b"\xff\xd8") :].rstrip(b"\r\n")) == SHADES["right"]
    wait_for(lambda: state_of_right(api)["frames_per_s"] is not None)  # since the second picture
    right = state_of_right(api)
    assert (right["name"], right["status"]) == ("right", "live")
    assert right["frame_id"] > 0
    assert right["last_frame_s"] < 10
    assert right["frames_per_s"] > 0


def test_viewers_watch_different_cameras_and_turn_to_others(api: CameraApi) -> None:
    with live_socket(api.address, "?camera=right") as one, live_socket(api.address) as other:
        number = next_of(one, "right").number
        next_of(other, "left")
        assert next_of(one, "right").skipped < 5  # pictures of the other camera are not its own
        other.send("camera right")
        assert next_of(other, "right").number > number
        other.send("camera")
        next_of(other, "left")


def test_an_unknown_camera_is_one_sentence_that_names_those_there_are(api: CameraApi, tmp_path: Path) -> None:
    asked = {"camera": "middle"}
    for path in ("/live.jpg", "/live.mjpg"):
        assert sentence(api.client.get(path, params=asked), 404) == THERE
    pick = {"x": 1, "y": 1, "camera": "middle"}
    assert sentence(api.client.post("/live/pick", json=pick), 404) == THERE
    assert sentence(api.client.post("/snapshots", json={"camera": "middle"}), 404) == THERE
    offer = api.client.post("/whep", params=asked, content=b"", headers={"Content-Type": "application/sdp"})
    assert sentence(offer, 404) == THERE
    for query, order in (("?camera=middle", "view"), ("", "camera middle")):
        with live_socket(api.address, query) as socket:
            with suppress(websockets.ConnectionClosed):
                socket.send(order)
            with pytest.raises(websockets.ConnectionClosed, match=THERE):
                follow(socket)
    with Client(f"http://{api.address}") as client, pytest.raises(ApiError, match=THERE):
        client.snapshot(tmp_path, camera="middle")


def test_a_name_of_any_length_fits_the_reason_of_a_closed_socket(api: CameraApi) -> None:
    socket = live_socket(api.address, f"?camera={'ä' * 64}")
    with socket, pytest.raises(websockets.ConnectionClosed, match="there is no camera"):
        socket.recv(timeout=10)


def test_where_the_first_is_silent_the_default_is_the_next_until_it_is_back(api: CameraApi) -> None:
    with event_socket(api.address) as events, live_socket(api.address) as socket:
        next_event(events, "hello")
        next_of(socket, "left")
        api.room.statuses = {"left": "silent", "right": "live"}
        event = next_event(events, "cameras")
        assert event["cameras"] == [
            {"name": "left", "status": "silent"},
            {"name": "right", "status": "live"},
        ]
        next_of(socket, "right")
        assert api.shade() == SHADES["right"]
        assert api.shade(camera="left") == SHADES["left"]  # its last picture
        api.room.statuses = dict.fromkeys(SHADES, "live")
        next_of(socket, "left")


def test_a_viewer_of_a_camera_that_is_gone_sees_the_one_there_is(api: CameraApi) -> None:
    with live_socket(api.address, "?camera=right") as socket:
        next_of(socket, "right")
        api.room.statuses = {"left": "live"}  # as where a replay takes the place of the cameras
        wait_for(lambda: statuses(api) == {"left": "live"})
        message: bytes | None = None
        while message is None or unpack(message)[0].node is not None:
            received = socket.recv(timeout=10)
            assert isinstance(received, bytes)
            message = received
            socket.send("ack")
        assert grey(unpack(message)[1]) == SHADES["left"]
        assert api.shade(camera="left") == SHADES["left"]
        answer = api.client.get("/live.jpg", params={"camera": "right"})
        assert sentence(answer, 404) == "there is no camera 'right'; there is left."


def test_pick_and_the_client_name_the_camera(api: CameraApi, monkeypatch: pytest.MonkeyPatch) -> None:
    frames_shown = {None: 5, "right": 7}

    def picked(_x: float, _y: float, _ignore: str | None, camera: str | None) -> SimpleNamespace:
        return SimpleNamespace(as_dict=lambda: {"frame_id": frames_shown[camera], **NOWHERE})

    monkeypatch.setattr(api.server.renderer, "pick", picked)
    with Client(f"http://{api.address}") as client:
        assert client.cameras() == ["left", "right"]
        assert client.pick(1, 2)["frame_id"] == 5
        assert client.pick(1, 2, camera="right")["frame_id"] == 7
        frames = client.frames(camera="right")
        assert next(frames).header.node == "right"
        frames.close()  # type: ignore[attr-defined]
    processes = api.client.get("/nodes").json()
    assert {each["name"]: each["kind"] for each in processes} == {"render-server": "render_server"}


@pytest.mark.skipif(why_unavailable() is not None, reason="no H.264 here")
def test_each_camera_is_encoded_for_itself(api: CameraApi) -> None:
    with (
        live_socket(api.address, "?camera=right&codec=h264") as one,
        live_socket(api.address, "?codec=h264") as other,
    ):
        for socket, node in ((one, "right"), (other, "left")):
            before = None
            for _ in range(20):
                message = socket.recv(timeout=20)
                assert isinstance(message, bytes)
                before, _ = unpack(message, before)
                assert before.node == node
                socket.send("ack")
            assert before is not None
            assert before.codec != "jpeg"
        text = api.client.get("/metrics").text
        assert "deltalight_live_encoders 2.0" in text
