"""The fish-eye picture and where the lights are in it; cameras of this host."""

import json
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.protocol.codecs import encode_array, encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import RadianceMessage
from deltalight.protocol.publisher import Publisher
from deltalight.sensor_node.cameras.driver import FoundCamera, MissingSupport
from deltalight.services import ports
from deltalight.services.api import camera_finder
from deltalight.services.api.fisheye import lights_in_picture
from tests.services.api_samples import running_api, sentence
from tests.services.conftest import IDENTITY
from tests.services.live_samples import LiveApi, live_api

LENS_EDGE, PICTURE_EDGE, FOCAL_PX = 400, 100, 120.0
SPHERE = {"type": "sphere", "intensity": [2.0, 1.0, 0.5], "radius_m": 0.1}


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveApi]:
    with live_api(tmp_path_factory.mktemp("data")) as running:
        yield running


def radiance() -> RadianceMessage:
    """A lens that looks up (its axes are the world's), radius = focal length x angle; a picture a quarter as wide."""
    middle = (LENS_EDGE - 1) / 2
    lens = {
        "width": LENS_EDGE,
        "height": LENS_EDGE,
        "matrix": [[FOCAL_PX, 0, middle], [0, FOCAL_PX, middle], [0, 0, 1]],
        "distortion_model": "equidistant",
        "distortion": [0.0, 0.0, 0.0, 0.0],
        "image_circle": None,
    }
    return RadianceMessage(
        node="desk",
        frame_id=1,
        capture_ns=12345,
        encoding="raw",
        size=8,
        picture_shape=(PICTURE_EDGE, PICTURE_EDGE, 3),
        clipped_share=0.25,
        world_from_fisheye=IDENTITY,
        camera={"lens": lens, "vignetting": [], "response": None},
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"type": "moon"},
        {"type": ["sphere"]},
        {"type": "sphere"},
        {**SPHERE, "position_m": "up"},
        {**SPHERE, "position_m": [0.0, 0.0, 0.0]},
        {**SPHERE, "position_m": [0.0, 0.0, 2.0], "intensity": [1e308, 1e308, 1e308]},
        {**SPHERE, "position_m": [0.0, 0.0, 2.0], "id": "four"},
    ],
)
def test_lights_that_no_render_server_describes_so_are_left_out(wrong: dict[str, object]) -> None:
    right = {**SPHERE, "position_m": [0.0, 0.0, 2.0]}
    assert len(lights_in_picture(radiance(), [wrong, right])) == 1


def test_lights_are_where_the_lens_shows_them() -> None:
    described: list[dict[str, Any]] = [
        {**SPHERE, "position_m": [0.0, 0.0, 2.0], "id": 4},
        {
            "type": "directional",
            "direction": [0.0, -np.sin(0.5), -np.cos(0.5)],
            "irradiance": [1.0, 1.0, 1.0],
            "angular_radius_deg": 2.0,
        },
        {**SPHERE, "position_m": [0.0, 0.0, -2.0]},  # below: the lens does not see it
        {"type": "environment", "mean_radiance": [1, 1, 1]},
    ]
    above, tilted = lights_in_picture(radiance(), described)
    middle, scale = (PICTURE_EDGE - 1) / 2, PICTURE_EDGE / LENS_EDGE
    assert (above.x, above.y) == pytest.approx((middle, middle), abs=1e-3)
    assert above.radius_px == pytest.approx(FOCAL_PX * np.arcsin(0.05) * scale, rel=1e-3)
    assert above.irradiance == pytest.approx((0.5, 0.25, 0.125))
    assert above.color_linear == pytest.approx((1.0, 0.5, 0.25))
    assert above.id == 4
    assert (tilted.x, tilted.y) == pytest.approx((middle, middle + FOCAL_PX * 0.5 * scale), abs=1e-3)
    assert tilted.radius_px == pytest.approx(FOCAL_PX * np.radians(2) * scale, rel=0.05)
    assert tilted.type == "directional"


def test_every_kind_of_light_has_a_place() -> None:
    place = {"position_m": [0.0, 0.5, 2.0]}
    spot = {**SPHERE, **place, "type": "spot", "direction": [0.0, 0.0, -1.0], "angle_deg": 60.0, "blend": 0.2}
    rectangle = {**place, "type": "rectangle", "axis_u_m": [0.0, 0.2, 0.0], "axis_v_m": [0.2, 0.0, 0.0]}
    lights = lights_in_picture(radiance(), [spot, {**rectangle, "radiance": [3.0, 3.0, 3.0]}])
    assert [light.type for light in lights] == ["spot", "rectangle"]
    for light in lights:
        assert light.y > (PICTURE_EDGE - 1) / 2
        assert light.radius_px > 0
        assert max(light.color_linear) == pytest.approx(1.0)


def test_without_a_fisheye_camera_there_is_neither_picture_nor_light(tmp_path: Path) -> None:
    with running_api(tmp_path) as api:
        for path in ("/fisheye", "/fisheye.jpg"):
            assert "fish-eye" in sentence(api.client.get(path), 404)


def test_picture_and_lights_come_by_rest(live: LiveApi) -> None:
    client = live.client
    wait_for_light(live, live.stream.publisher, radiance())
    answer = client.get("/fisheye").json()
    assert (answer["width"], answer["height"]) == (PICTURE_EDGE, PICTURE_EDGE)
    assert (answer["seen_ns"], answer["node"], answer["clipped_share"]) == (12345, "desk", 0.25)
    assert [light["type"] for light in answer["lights"]] == ["sphere"]
    assert client.get("/fisheye.jpg").content == parts()[2]


def parts() -> list[bytes]:
    """What follows the header of `radiance`."""
    jpeg = encode_color(np.full((PICTURE_EDGE, PICTURE_EDGE, 3), 90, np.uint8))
    grid = encode_array(np.zeros((8, 8, 3), np.float32), "raw")
    return [grid, encode_array(np.ones((8, 8), np.uint8), "raw"), jpeg]


def wait_for_light(live: LiveApi, publisher: Publisher, message: RadianceMessage) -> None:
    """Sends until the API shows the light of this node."""
    for _ in range(600):
        publisher.send(encode(message, parts()))
        if live.client.get("/fisheye").json().get("node") == message.node:
            return
        time.sleep(0.05)
    pytest.fail("the light was never shown")


def test_while_a_recording_is_shown_its_light_is_the_one_that_counts(live: LiveApi) -> None:
    (port,) = ports.private_ports(1)
    replay = Publisher(ports.endpoint(port))
    streams = live.api.app.state.context.link  # type: ignore[attr-defined]
    try:
        streams.on_source([ports.endpoint(port)])
        recorded = radiance().model_copy(update={"node": "replay"})
        wait_for_light(live, replay, recorded)
        for _ in range(3):
            live.stream.publisher.send(encode(radiance(), parts()))
            time.sleep(0.1)
        assert live.client.get("/fisheye").json()["node"] == "replay"
        streams.on_source(None)
        wait_for_light(live, live.stream.publisher, radiance())
    finally:
        replay.close()


def search(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Has cameras searched for by another program."""
    monkeypatch.setattr(camera_finder, "COMMAND", (sys.executable, "-c", script))


def test_cameras_of_this_host_are_listed(live: LiveApi, monkeypatch: pytest.MonkeyPatch) -> None:
    found = FoundCamera("Webcam", "uvc:0", "uvc", "/dev/video0", "no permission")
    missing = MissingSupport("oak", "not installed", "install it")
    listed = json.dumps({"cameras": [found.as_dict()], "missing": [asdict(missing)]})
    search(monkeypatch, f"print({listed!r})")
    answer = live.client.get("/cameras").json()
    assert answer["cameras"] == [found.as_dict()]
    assert answer["missing"][0]["hint"] == "install it"


def test_a_search_that_hangs_is_a_sentence_and_ends(live: LiveApi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_finder, "TIMEOUT_S", 0.05)
    search(monkeypatch, "import time; time.sleep(60)")
    assert "takes too long" in sentence(live.client.get("/cameras"), 503)
    while any(thread.name == "cameras" for thread in threading.enumerate()):
        time.sleep(0.01)  # its process was killed


@pytest.mark.parametrize("script", ["raise SystemExit(139)", "print('a camera')", "print('{}')"])
def test_a_search_that_fails_is_a_sentence(
    live: LiveApi, monkeypatch: pytest.MonkeyPatch, script: str
) -> None:
    search(monkeypatch, script)
    assert "without an answer" in sentence(live.client.get("/cameras"), 503)
