"""WHEP: real peers (aiortc, Chromium) watch the live picture on loopback; what ends a session; what is refused."""

import asyncio
import socket
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import aioice.ice
import httpx
import numpy as np
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection, RTCRtpTransceiver, RTCSessionDescription
from av import VideoFrame

from deltalight.services import ports
from deltalight.services.api import limits, webrtc, whep
from deltalight.services.api.webrtc import listen_at
from deltalight.services.h264 import H264Encoder, rgb_picture
from tests.services.api_samples import sentence
from tests.services.camera_samples import SHADES, camera_api
from tests.services.dashboard_samples import CHROMIUM, chromium
from tests.services.live_samples import live_socket
from tests.services.moving_samples import Picture, Running, moving_api, psnr_db

MOST_CODES = 3.0  # of a grey picture's mean from what was sent
LEAST_PSNR_DB = 35.0  # of a picture from its JPEG; those of the WebSocket agree as much
PATIENCE_S = 60.0
SDP = {"Content-Type": "application/sdp"}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with moving_api(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture
def live(running: Running) -> Iterator[Running]:
    yield running
    wait_until(lambda: viewers(running) == 0)


def viewers(running: Running) -> int:
    text = running.api.client.get("/metrics").text
    return int(float(text.split("\ndeltalight_live_viewers ")[1].split()[0]))


def wait_until(is_so: object) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not is_so():  # type: ignore[operator]
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


class Player:
    """A client of WHEP."""

    def __init__(self) -> None:
        self.peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self.video: RTCRtpTransceiver = self.peer.addTransceiver("video", "recvonly")
        listen_at(self.video, [ports.LOOPBACK])

    async def offer(self) -> str:
        await self.peer.setLocalDescription()
        return self.peer.localDescription.sdp

    async def take(self, answer: str) -> None:
        await self.peer.setRemoteDescription(RTCSessionDescription(answer, "answer"))

    async def frame(self) -> VideoFrame:
        frame = await asyncio.wait_for(self.video.receiver.track.recv(), PATIENCE_S)
        assert isinstance(frame, VideoFrame)
        return frame

    async def picture(self) -> Picture:
        return rgb_picture(await self.frame())

    async def until_closed(self) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while self.peer.connectionState != "closed":
                await asyncio.sleep(0.02)


def made_offer(*kinds: str) -> str:
    """An offer of an RTCPeerConnection that would receive these."""

    async def make() -> str:
        peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        for kind in kinds:
            if kind == "data":
                peer.createDataChannel("any")
            else:
                peer.addTransceiver(kind, "recvonly")
        await peer.setLocalDescription()
        made = peer.localDescription.sdp
        await peer.close()
        return made

    return asyncio.run(make())


@asynccontextmanager
async def watching(
    client: httpx.Client, path: str = "/whep", **headers: str
) -> AsyncIterator[tuple[Player, str]]:
    """A player that gets pictures, and the path of its session."""
    player = Player()
    answer = client.post(path, content=await player.offer(), headers=SDP | headers)
    assert answer.status_code == 201, answer.text
    assert answer.headers["content-type"] == "application/sdp"
    await player.take(answer.text)
    try:
        yield player, answer.headers["location"].removeprefix("/api/v1")
    finally:
        await player.peer.close()


@pytest.mark.parametrize("path", ["/whep", "/rooms/room/whep?view=composite"])
def test_pictures_are_those_of_the_jpegs_from_the_shared_encoder_and_delete_ends_them(
    live: Running, path: str
) -> None:
    async def watch() -> None:
        client = live.api.client
        with live_socket(live.address, "?codec=h264"):
            async with watching(client, path) as (player, session):
                frames = []
                for _ in range(20):
                    agreement_db, frame_id = live.closest(await player.picture())
                    assert agreement_db > LEAST_PSNR_DB
                    frames.append(frame_id)
                assert frames == sorted(frames)
                assert len(set(frames)) > 15
                assert sum(thread.name == "live-video" for thread in threading.enumerate()) == 1
                assert "profile-level-id=64" in player.peer.remoteDescription.sdp
                assert client.delete(session).status_code == 200
                await player.until_closed()
                assert "no such WHEP session" in sentence(client.delete(session), 404)

    asyncio.run(watch())


def test_each_viewer_gets_the_camera_that_it_names_and_else_the_first(tmp_path: Path) -> None:
    async def watch(client: httpx.Client) -> None:
        async with watching(client, "/whep?camera=right") as (right, _), watching(client) as (first, _):
            for _ in range(5):
                for player, camera in ((right, "right"), (first, "left")):
                    shown = (await player.picture()).mean()
                    assert shown == pytest.approx(SHADES[camera], abs=MOST_CODES)

    with camera_api(tmp_path) as api:
        wait_until(lambda: len(api.client.get("/state").json()["cameras"]) == len(SHADES))
        asyncio.run(watch(api.client))


def test_who_lost_a_picture_gets_a_keyframe(live: Running) -> None:
    async def watch() -> None:
        async with watching(live.api.client) as (player, _):
            assert (await player.frame()).key_frame
            for _ in range(5):
                assert not (await player.frame()).key_frame
            (source,) = player.video.receiver.getSynchronizationSources()
            await player.video.receiver._send_rtcp_pli(source.source)
            for _ in range(100):
                if (frame := await player.frame()).key_frame:
                    break
            assert frame.key_frame
            assert live.closest(rgb_picture(frame))[0] > LEAST_PSNR_DB

    asyncio.run(watch())


def test_a_session_ends_with_its_peer_and_with_one_that_never_comes(
    live: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def watch() -> None:
        async with watching(live.api.client) as (player, _):
            await player.picture()
        wait_until(lambda: viewers(live) == 0)

    async def fall_silent() -> None:
        async with watching(live.api.client) as (player, _):
            await player.picture()
            ice = player.video.receiver.transport.transport
            for protocol in ice._connection._protocols:
                protocol.transport.abort()
            wait_until(lambda: viewers(live) == 0)

    asyncio.run(watch())
    monkeypatch.setattr(aioice.ice, "CONSENT_INTERVAL", 0.1)
    asyncio.run(fall_silent())
    monkeypatch.setattr(webrtc, "CONNECT_TIMEOUT_S", 1.0)
    answer = live.api.client.post("/whep", content=made_offer("video"), headers=SDP)
    assert answer.status_code == 201
    assert viewers(live) == 1
    wait_until(lambda: viewers(live) == 0)


def test_nothing_is_sent_to_the_candidates_of_an_offer(
    live: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webrtc, "CONNECT_TIMEOUT_S", 1.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as third_party:
        third_party.bind((ports.LOOPBACK, 0))
        third_party.setblocking(False)
        port = third_party.getsockname()[1]
        candidate = f"a=candidate:1 1 udp 2130706431 {ports.LOOPBACK} {port} typ host\r\n"
        offer = made_offer("video") + candidate
        assert live.api.client.post("/whep", content=offer, headers=SDP).status_code == 201
        wait_until(lambda: viewers(live) == 0)
        with pytest.raises(BlockingIOError):
            third_party.recv(1)


def test_ports_are_open_at_the_address_of_the_service_alone(live: Running) -> None:
    answer = live.api.client.post("/whep", content=made_offer("audio", "video"), headers=SDP)
    assert answer.status_code == 201
    candidates = [line for line in answer.text.splitlines() if line.startswith("a=candidate:")]
    assert candidates
    assert {line.split()[4] for line in candidates} == {ports.LOOPBACK}
    assert "a=inactive" in answer.text, "no sound is taken"
    live.api.client.delete(answer.headers["location"].removeprefix("/api/v1"))


def without_h264(offer: str) -> str:
    return offer.replace("H264/90000", "H265/90000")


def test_wrong_offers_are_one_sentence(live: Running) -> None:
    good = made_offer("video")
    for offer, words in (
        ("", "not an SDP offer"),
        ("v=0\r\n", "not an SDP offer"),
        ("\0" * 100, "not an SDP offer"),
        ('{"type": "offer"}', "not an SDP offer"),
        (good[: len(good) // 3], "not an SDP offer"),
        (good.replace("a=ice-ufrag", "a=x"), "not an SDP offer"),
        (good.replace("a=fingerprint", "a=x"), "not an SDP offer"),
        (good.replace("a=recvonly", "a=sendonly"), "one video"),
        (made_offer("audio"), "one video"),
        (made_offer("video", "data"), "one video"),
        (without_h264(good), "has no H.264"),
        (good + "a=x\r\n" * 20_000, "64 kB"),
    ):
        answer = live.api.client.post("/whep", content=offer.encode(), headers=SDP)
        assert words in sentence(answer, 400), offer[:80]
    answer = live.api.client.post("/whep", content=b"\xff", headers=SDP)
    assert "UTF-8" in sentence(answer, 400)
    assert "application/sdp" in sentence(live.api.client.post("/whep", json={}), 415)
    assert live.api.client.patch("/whep/any", content="").status_code == 405
    described = live.api.client.options("/whep")
    assert (described.status_code, described.headers["accept-post"]) == (204, "application/sdp")


def test_tokens_and_tickets_let_in_and_revoking_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(limits, "CHECK_INTERVAL_S", 0.1)
    offer = made_offer("video")
    with moving_api(tmp_path, host="0.0.0.0", whep_host=ports.LOOPBACK, whep_sessions=2) as running:
        client, tokens = running.api.client, running.api.store.tokens
        assert "token is needed" in sentence(client.post("/whep", content=offer, headers=SDP), 401)
        bearer = {"Authorization": f"Bearer {tokens.create('wall', 'view')}"}
        ticket = client.post("/tickets", headers=bearer).json()["ticket"]
        let_in = client.post(f"/whep?ticket={ticket}", content=offer, headers=SDP)
        assert let_in.status_code == 201
        again = client.post(f"/whep?ticket={ticket}", content=offer, headers=SDP)
        assert "is unknown" in sentence(again, 401)
        session = let_in.headers["location"].removeprefix("/api/v1")
        assert "token is needed" in sentence(client.delete(session), 401)

        async def watch() -> None:
            async with watching(client, **bearer) as (player, _):
                await player.picture()
                full = client.post("/whep", content=offer, headers=SDP | bearer)
                assert "All WHEP sessions" in sentence(full, 429)
                assert client.delete(session, headers=bearer).status_code == 200
                tokens.revoke("wall")
                await player.until_closed()

        asyncio.run(watch())
        for text in capfd.readouterr():
            assert bearer["Authorization"].split()[1] not in text
            assert ticket not in text
            assert session.rsplit("/", maxsplit=1)[1] not in text


def test_an_encoder_that_fails_ends_the_session(live: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ValueError("out of memory")

    async def watch() -> None:
        async with watching(live.api.client) as (player, _):
            await player.picture()
            monkeypatch.setattr(H264Encoder, "encode", fail)
            await player.until_closed()

    asyncio.run(watch())


def test_where_there_is_no_whep_a_sentence_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with moving_api(tmp_path / "off", whep_sessions=0) as running:
        assert "disabled" in running.api.client.get("/settings").json()["no_whep"]
    with moving_api(tmp_path / "elsewhere", whep_host="192.0.2.1") as running:  # RFC 5737: nobody's
        answer = running.api.client.post("/whep", content=made_offer("video"), headers=SDP)
        assert "No UDP port opens at 192.0.2.1" in sentence(answer, 503)
        assert viewers(running) == 0
    monkeypatch.setattr(whep, "find_spec", lambda _name: None)
    with moving_api(tmp_path / "without") as running:
        answer = running.api.client.post("/whep", content="v=0", headers=SDP)
        assert "aiortc" in sentence(answer, 503)
        assert running.api.client.get("/settings").json()["no_whep"] == answer.json()["detail"]


WATCH = """async () => {
  const peer = new RTCPeerConnection()
  peer.addTransceiver('video', {direction: 'recvonly'})
  const video = document.createElement('video')
  video.muted = true
  document.documentElement.append(video)
  peer.ontrack = event => { video.srcObject = new MediaStream([event.track]); video.play() }
  await peer.setLocalDescription()
  const headers = {'Content-Type': 'application/sdp'}
  const answer = await fetch('/api/v1/whep', {method: 'POST', headers, body: peer.localDescription.sdp})
  await peer.setRemoteDescription({type: 'answer', sdp: await answer.text()})
  while (video.getVideoPlaybackQuality().totalVideoFrames < 8) await new Promise(done => setTimeout(done, 20))
  const canvas = document.createElement('canvas')
  Object.assign(canvas, {width: video.videoWidth, height: video.videoHeight})
  const context = canvas.getContext('2d')
  context.drawImage(video, 0, 0)
  const pixels = [...context.getImageData(0, 0, canvas.width, canvas.height).data]
  await fetch(answer.headers.get('Location'), {method: 'DELETE'})
  return {width: canvas.width, height: canvas.height, pixels}
}"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)")
def test_chromium_shows_what_the_jpeg_shows(live: Running) -> None:
    before = max(live.stream.jpegs)
    with chromium() as browser:  # no fixture: while it runs, this thread runs no other event loop
        page = browser.new_page()
        page.goto(f"http://{live.address}/openapi.json")
        shown = page.evaluate(WATCH)
        seen = np.array(shown["pixels"], np.uint8).reshape(shown["height"], shown["width"], 4)[..., :3]
        agreement_db, _ = live.closest(seen, after=before)
    assert agreement_db > LEAST_PSNR_DB
    assert psnr_db(seen, np.roll(seen, 2, axis=1)) < agreement_db, "a shift by two pixels would show"
