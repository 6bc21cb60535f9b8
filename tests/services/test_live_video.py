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
from jaxtyping import UInt8
from playwright.sync_api import Browser
from websockets.sync.client import ClientConnection

from deltalight.protocol.codecs import decode_color, encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.publisher import Publisher
from deltalight.services import ports
from deltalight.services.api.live_video import KEY_INTERVAL_S
from deltalight.services.h264 import H264Decoder, H264Encoder
from deltalight.services.live_message import LiveHeader, unpack
from tests.services.api_samples import RenderServer, running_api
from tests.services.dashboard_samples import NEEDS_BROWSER, complaints_of
from tests.services.live_samples import composite, event_socket, live_socket, next_event, wait_for_frames

Picture = UInt8[np.ndarray, "h w 3"]
WIDTH, HEIGHT = 160, 120
LEAST_PSNR_DB = 36.0  # of a picture from its JPEG; the encoder's constant quality gives 38 to 42
PERIOD_S = 0.04
PATIENCE_S = 30.0


class MovingStream:
    """Publishes a moving picture of smooth shapes and some texture; none while it `is_paused`."""

    def __init__(self, port: int, width: int = WIDTH, height: int = HEIGHT) -> None:
        self.size, self.is_paused, self.is_still = (width, height), False, False
        self.jpegs: dict[int, bytes] = {}  # by frame id
        self._publisher = Publisher(ports.endpoint(port))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._publisher.close()

    def _run(self) -> None:
        number, phase = 0, 0
        while not self._stop.wait(PERIOD_S):
            if self.is_paused:
                continue
            number, phase = number + 1, phase + (not self.is_still)
            width, height = self.size
            self.jpegs[number] = encode_color(picture(width, height, phase))
            camera = composite(1).camera | {"width": width, "height": height}
            message = composite(number).model_copy(
                update={"shape": (height, width, 3), "camera": camera, "reused_pass_times_ms": {}}
            )
            self._publisher.send(encode(message, [self.jpegs[number]]))


def picture(width: int, height: int, phase: int) -> Picture:
    """Coloured shapes with soft edges that move by two pixels a phase."""
    rows, columns = np.mgrid[:height, :width]
    waves = [np.sin((columns + 2 * phase) / 17.0), np.cos(rows / 13.0), np.sin((rows + columns) / 23.0)]
    return np.stack([127 + 100 * wave for wave in waves], axis=-1).astype(np.uint8)


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


def psnr_db(one: Picture, other: Picture) -> float:
    return float(10 * np.log10(255**2 / max(1e-6, np.mean((one.astype(float) - other) ** 2))))


class Running:
    """A web process over a moving stream."""

    def __init__(self, address: str, stream: MovingStream) -> None:
        self.address, self.stream = address, stream

    def agrees(self, header: LiveHeader, seen: Picture | None) -> float:
        """PSNR of a picture from the JPEG of its frame, dB."""
        assert seen is not None
        jpeg = memoryview(self.stream.jpegs[header.frame_id])
        return psnr_db(seen, decode_color(jpeg, "jpeg", seen.shape))


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    control, published = ports.private_ports(2)
    stream, server = MovingStream(published), RenderServer(control)
    try:
        with running_api(
            tmp_path_factory.mktemp("data"),
            control=ports.endpoint(control),
            subscribe=[ports.endpoint(published)],
        ) as api:
            address = f"{ports.LOOPBACK}:{api.client.base_url.port}"
            wait_for_frames(address)
            scene = api.client.post("/scenes", json={"name": "live"}).json()["id"]
            api.client.post(f"/scenes/{scene}/activate").raise_for_status()
            yield Running(address, stream)
    finally:
        stream.close()
        server.close()


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
@NEEDS_BROWSER[1]
@NEEDS_BROWSER[2]
def test_the_dashboard_shows_what_the_jpeg_shows(live: Running, browser: Browser) -> None:
    live.stream.is_still = True
    with browser.new_context(viewport={"width": 1280, "height": 800}) as context:
        page = context.new_page()
        complaints = complaints_of(page)
        page.goto(f"http://{live.address}/")
        page.get_by_role("tab", name="Performance").click()
        page.get_by_text("H.264, ").wait_for(timeout=PATIENCE_S * 1000)
        page.wait_for_timeout(1500)  # until the still picture is refined
        shown = page.get_by_role("img", name="Live picture", exact=True).evaluate(
            "canvas => [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]"
        )
        seen = np.array(shown, np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]
        jpeg = memoryview(live.stream.jpegs[max(live.stream.jpegs)])
        agreement_db = psnr_db(seen, decode_color(jpeg, "jpeg", seen.shape))
        assert agreement_db > LEAST_PSNR_DB, agreement_db
        bias = seen.astype(float).mean((0, 1)) - decode_color(jpeg, "jpeg", seen.shape).mean((0, 1))
        assert np.abs(bias).max() < 1.0, "colours are neither stretched nor turned"
        assert complaints == []
