"""Live pictures as H.264: what viewers get beside JPEG, who joins, falls behind or has no encoder."""

import importlib.abc
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import websockets
from playwright.sync_api import Browser
from websockets.sync.client import ClientConnection

from deltalight.protocol.codecs import decode_color
from deltalight.protocol.errors import DeltalightError
from deltalight.services import ports
from deltalight.services.api.live_video import KEY_INTERVAL_S
from deltalight.services.h264 import H264Decoder, H264Encoder
from deltalight.services.live_message import LiveHeader, unpack
from tests.services.api_samples import running_api
from tests.services.dashboard_samples import USES_BROWSER, complaints_of
from tests.services.live_samples import event_socket, live_socket, next_event
from tests.services.moving_samples import (
    HEIGHT,
    WIDTH,
    MovingStream,
    Picture,
    Running,
    moving_api,
    psnr_db,
)

LEAST_PSNR_DB = 36.0  # of a picture from its JPEG; the encoder's constant quality gives 38 to 42
PATIENCE_S = 60.0


class Viewer:
    """A client of `WS /live` that decodes what it gets."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self._decoder = H264Decoder()
        self.header: LiveHeader | None = None
        self.bytes = 0

    def next(self) -> tuple[LiveHeader, Picture | None]:
        """The next picture, acknowledged; None where it is the one before."""
        message = self.socket.recv(timeout=PATIENCE_S)
        assert isinstance(message, bytes)
        self.socket.send("ack")
        self.bytes = len(message)
        self.header, coded = unpack(message, self.header)
        width, height = self.header.camera.width, self.header.camera.height
        if self.header.codec == "jpeg":
            return self.header, decode_color(memoryview(coded), "jpeg", (height, width, 3))
        return self.header, self._decoder.decode(coded, width, height) if coded else None

    def until(self, codec: str) -> LiveHeader:
        """The first header of a codec whose name begins so."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            header, _ = self.next()
            if header.codec.startswith(codec):
                return header
        pytest.fail(f"no picture came as {codec}")


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with moving_api(tmp_path_factory.mktemp("data")) as running:
        scene = running.api.client.post("/scenes", json={"name": "live"}).json()["id"]
        running.api.client.post(f"/scenes/{scene}/activate").raise_for_status()
        yield running


@pytest.fixture
def live(running: Running) -> Running:
    running.stream.is_paused = running.stream.is_still = False
    running.stream.size = (WIDTH, HEIGHT)
    return running


def test_pictures_are_those_of_the_jpegs_and_a_second_viewer_shares_them(live: Running) -> None:
    with live_socket(live.address, "?codec=h264") as one, live_socket(live.address) as old:
        first, late = Viewer(one), None
        header, seen = first.next()
        assert header.codec.startswith("avc1.")
        assert header.keyframe
        assert live.agrees(header, seen) > LEAST_PSNR_DB
        keys, numbers = 0, [header.number]
        with live_socket(live.address) as other:
            other.send("codec h264")
            late = Viewer(other)
            joined = late.until("avc1.")
            assert joined.keyframe, "who joins begins with a key"
            for _ in range(20):
                header, seen = first.next()
                numbers.append(header.number)
                keys += header.keyframe
                assert live.agrees(header, seen) > LEAST_PSNR_DB
                assert live.agrees(*late.next()) > LEAST_PSNR_DB
        assert numbers == sorted(set(numbers)) or len(numbers) - len(set(numbers)) <= 1
        assert keys <= 2, "only for the one who joined"
        assert Viewer(old).next()[0].codec == "jpeg"
        first.socket.send("codec jpeg")
        first.until("jpeg")


def test_what_stands_still_is_refined_and_then_costs_next_to_nothing(live: Running) -> None:
    live.stream.is_still = True
    with live_socket(live.address, "?codec=h264") as socket:
        viewer = Viewer(socket)
        first = live.agrees(*viewer.next())
        best, header_only = first, 0
        for _ in range(40):
            header, seen = viewer.next()
            if seen is not None:
                best = live.agrees(header, seen)
            else:
                header_only = viewer.bytes
        assert best > first
        jpeg = len(live.stream.jpegs[header.frame_id])
        assert 0 < header_only < jpeg / 10
        live.stream.is_still = False
        while (shown := viewer.next())[1] is None:
            pass
        assert live.agrees(*shown) > LEAST_PSNR_DB


def test_who_falls_behind_goes_on_with_a_key_and_delays_nobody(live: Running) -> None:
    with (
        live_socket(live.address, "?codec=h264") as slow,
        live_socket(live.address, "?codec=h264") as fast,
    ):
        late, quick = Viewer(slow), Viewer(fast)
        before, _ = late.next()
        gaps = []
        last = quick.next()[0]
        for _ in range(40):
            header, _ = quick.next()
            gaps.append(header.number - last.number)
            last = header
        assert np.mean(gaps) < 1.5, "it missed next to nothing"
        for _ in range(4):  # what was on its way
            before, _ = late.next()
        while not (now := late.next())[0].keyframe:
            before = now[0]
        assert now[0].number - before.number > 10
        assert now[0].skipped >= now[0].number - before.number - 1
        assert now[0].number >= last.number
        assert live.agrees(*now) > LEAST_PSNR_DB
        assert live.agrees(*late.next()) > LEAST_PSNR_DB, "and follows again"


def test_a_key_comes_at_once_though_no_new_picture_does(live: Running) -> None:
    with live_socket(live.address, "?codec=h264") as one, live_socket(live.address) as other:
        Viewer(one).next()
        live.stream.is_paused = True
        time.sleep(KEY_INTERVAL_S)
        late = Viewer(other)
        other.send("codec h264")
        header = late.until("avc1.")
        assert header.keyframe


def test_an_odd_size_and_another_size_in_between(live: Running) -> None:
    with live_socket(live.address, "?codec=h264") as socket:
        viewer = Viewer(socket)
        viewer.next()
        for size in ((161, 121), (96, 72)):
            live.stream.size = size
            while viewer.header is None or viewer.header.camera.width != size[0]:
                header, seen = viewer.next()
            assert header.keyframe
            assert seen is not None
            assert seen.shape == (size[1], size[0], 3)
            assert live.agrees(header, seen) > LEAST_PSNR_DB


def test_the_encoder_ends_with_its_last_viewer(live: Running) -> None:
    def encoding() -> int:
        return sum(thread.name == "live-video" for thread in threading.enumerate())

    with live_socket(live.address, "?codec=h264") as one, live_socket(live.address, "?codec=h264") as other:
        Viewer(one).next()
        Viewer(other).next()
        assert encoding() == 1
    deadline_s = time.monotonic() + PATIENCE_S
    while encoding() and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert encoding() == 0


def test_an_encoder_that_fails_is_told_of_and_jpeg_goes_on(
    live: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise DeltalightError("The encoder libx264 failed: out of memory.")

    with event_socket(live.address) as events, live_socket(live.address, "?codec=h264") as socket:
        viewer = Viewer(socket)
        viewer.until("avc1.")
        monkeypatch.setattr(H264Encoder, "encode", fail)
        header = viewer.until("jpeg")
        assert live.agrees(*viewer.next()) > 60
        assert header.keyframe
        assert "goes on as JPEG: The encoder libx264" in next_event(events, "notice")["text"]


def test_a_codec_that_there_is_not_ends_the_connection_with_a_sentence(live: Running) -> None:
    for query, message in (("?codec=h265", None), ("", "codec h265")):
        with live_socket(live.address, query) as socket:
            if message is not None:
                socket.send(message)
            with pytest.raises(websockets.ConnectionClosed, match="no such codec; ask for one of jpeg, h264"):
                list(iter(lambda: socket.recv(timeout=PATIENCE_S), None))


class _Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name: str, *_: object) -> None:
        if name.partition(".")[0] == "av":
            raise ModuleNotFoundError(name)


def test_without_pyav_jpeg_goes_on_and_settings_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [each for each in sys.modules if each.partition(".")[0] == "av"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_Blocked(), *sys.meta_path])
    control, published = ports.private_ports(2)
    stream = MovingStream(published)
    try:
        with (
            running_api(
                tmp_path, control=ports.endpoint(control), subscribe=[ports.endpoint(published)]
            ) as api,
            live_socket(f"{ports.LOOPBACK}:{api.client.base_url.port}", "?codec=h264") as socket,
        ):
            settings = api.client.get("/settings").json()
            assert settings["live_codecs"] == ["jpeg"]
            assert "PyAV" in settings["no_h264"]
            message = socket.recv(timeout=PATIENCE_S)
            assert isinstance(message, bytes)
            assert unpack(message)[0].codec == "jpeg"
    finally:
        stream.close()


@pytest.mark.slow
@USES_BROWSER
def test_the_dashboard_shows_what_the_jpeg_shows(live: Running, browser: Browser) -> None:
    live.stream.is_still = True
    with browser.new_context(viewport={"width": 1280, "height": 800}) as context:
        page = context.new_page()
        complaints = complaints_of(page)
        page.goto(f"http://{live.address}/")
        page.get_by_role("tab", name="Performance").click()
        page.get_by_text("H.264, ").wait_for(timeout=PATIENCE_S * 1000)
        agreement_db, deadline_s = 0.0, time.monotonic() + PATIENCE_S
        while agreement_db <= LEAST_PSNR_DB and time.monotonic() < deadline_s:  # what stands still is refined
            page.wait_for_timeout(100)
            shown = page.get_by_role("img", name="Live picture", exact=True).evaluate(
                "canvas => [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]"
            )
            seen = np.array(shown, np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]
            jpeg = decode_color(memoryview(live.stream.jpegs[max(live.stream.jpegs)]), "jpeg", seen.shape)
            agreement_db = psnr_db(seen, jpeg)
        assert agreement_db > LEAST_PSNR_DB, agreement_db
        bias = seen.astype(float).mean((0, 1)) - jpeg.mean((0, 1))
        assert np.abs(bias).max() < 1.0, "colours are neither stretched nor turned"
        assert complaints == []
