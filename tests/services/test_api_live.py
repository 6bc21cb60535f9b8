"""Live video: what viewers get, slow ones beside fast ones, tickets, and the end of open connections."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import httpx
import pytest
import websockets
from websockets.sync.client import ClientConnection

from deltalight.protocol.codecs import decode_color
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlRequest
from deltalight.services import ports
from deltalight.services.api.credentials import OPEN_TICKETS, TICKET_LIFE_S, Principal, Tickets
from deltalight.services.api.limits import STREAMS_PER_CLIENT
from deltalight.services.api.live_hub import WINDOW, LiveHub
from deltalight.services.live_message import unpack
from tests.services.api_samples import running_api, sentence
from tests.services.conftest import HEIGHT, ROOT, WIDTH
from tests.services.live_samples import (
    PATIENCE_S,
    LiveApi,
    StandInStream,
    composite,
    event_socket,
    live_api,
    live_socket,
    read_frame,
    shade,
    wait_for_frames,
)
from tests.services.test_api_scenes import wait_for

ENDED_BY_SIGTERM = 143
MANY = 20


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveApi]:
    with live_api(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveApi]:
    """With the rules of an address that leaves the host."""
    with live_api(tmp_path_factory.mktemp("data"), host="0.0.0.0") as running:
        yield running


def follow(socket: ClientConnection) -> None:
    """Looks until the connection ends."""
    while True:
        socket.send("ack")
        read_frame(socket)


def bearer(live: LiveApi, name: str, role: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {live.api.store.tokens.create(name, role)}"}  # type: ignore[arg-type]


def test_a_frames_header_says_what_it_shows_and_where_time_went(live: LiveApi) -> None:
    live.stream.scene = (None, 7)
    with live_socket(live.address) as socket:
        header = read_frame(socket)
    assert header["pass_times_ms"] == {"trace cones": 12.5, "compose": 1.0}
    assert header["reused_pass_times_ms"] == {"shadow maps": 3.0}
    assert header["drops"] == {"color.cam": 3}
    assert header["status"] == "ok"
    assert header["age_ms"] >= 5
    assert header["skipped"] == 0
    assert header["scene"] is None
    assert (header["camera"]["width"], header["camera"]["height"]) == (WIDTH, HEIGHT)
    assert header["world_from_camera"][3] == [0, 0, 0, 1]
    assert [light["type"] for light in header["lights"]] == ["sphere", "environment"]
    description = httpx.get(f"http://{live.address}/openapi.json", timeout=PATIENCE_S).json()
    assert set(header) == set(description["components"]["schemas"]["LiveHeader"]["properties"])
    assert {"number", "frame_id", "capture_ns", "frames_per_s", "renderer"} <= set(header)


def view_of(socket: ClientConnection, wanted: str) -> int:
    """The grey of the first picture in a view."""
    for _ in range(200):
        message = socket.recv(timeout=PATIENCE_S)
        socket.send("ack")
        assert isinstance(message, bytes)
        header, jpeg = unpack(message)
        if header.view == wanted:
            assert (header.world_from_camera is None) == (wanted != "composite")
            return int(decode_color(memoryview(jpeg), "jpeg", (HEIGHT, WIDTH, 3)).mean())
    pytest.fail(f"the view {wanted} never came")


def test_two_viewers_look_at_different_views_of_the_same_frames(live: LiveApi) -> None:
    with live_socket(live.address, "?view=delta") as one, live_socket(live.address) as other:
        assert view_of(one, "delta") == shade("delta")
        view_of(other, "composite")
        other.send("view camera")
        assert view_of(other, "camera") == shade("camera")
        assert view_of(one, "delta") == shade("delta")
        wait_for(lambda: live.server.session.watched == ("camera", "delta"))
        other.send("view")
        view_of(other, "composite")
    wait_for(lambda: live.server.session.watched == ())
    picture = live.client.get("/live.jpg", params={"view": "volume"}).content
    assert int(decode_color(memoryview(picture), "jpeg", (HEIGHT, WIDTH, 3)).mean()) == shade("volume")
    wait_for(lambda: live.server.session.watched == ())
    assert "view" in sentence(live.client.get("/live.jpg", params={"view": "sideways"}), 422)


@pytest.mark.parametrize(("query", "order"), [("?view=sideways", None), ("", "view sideways")])
def test_a_view_that_there_is_not_ends_the_connection(live: LiveApi, query: str, order: str | None) -> None:
    with live_socket(live.address, query) as socket:
        if order is not None:
            socket.send(order)
        with pytest.raises(websockets.ConnectionClosed, match="no such view; ask for one of composite, "):
            follow(socket)
    assert socket.protocol.close_code == 1008


def test_a_composite_without_a_camera_is_refused() -> None:
    hub = LiveHub()
    with pytest.raises(DeltalightError, match=r"`camera\.width`"):
        hub.publish(composite(1).model_copy(update={"camera": {}}), [b""], "")
    assert hub.newest is None


def test_a_frame_names_the_scene_and_revision_of_the_api(live: LiveApi) -> None:
    client = live.client
    scene_id = client.post("/scenes", json={"name": "shown"}).json()["id"]
    assert client.post(f"/scenes/{scene_id}/activate").json()["picture"]["state"] == "shown"
    live.stream.scene = shown(live)
    assert client.patch(f"/scenes/{scene_id}", json={"name": "renamed"}).json()["revision"] == 2
    with live_socket(live.address) as socket:
        assert next_scene(socket, None) == {"id": scene_id, "revision": 1}
        live.stream.scene = shown(live)
        assert next_scene(socket, {"id": scene_id, "revision": 1}) == {"id": scene_id, "revision": 2}
        live.server.session.execute(
            ControlRequest(node="other", id="r1", op="set_view", payload={"view": "delta"})
        )
        live.stream.scene = shown(live)
        assert live.stream.scene == (None, 3)
        assert next_scene(socket, {"id": scene_id, "revision": 2}) is None


def shown(live: LiveApi) -> tuple[str | None, int]:
    """What a picture of the render session would say that it shows."""
    session = live.server.session
    return session.scene_id, session.scene.revision


def next_scene(socket: ClientConnection, before: object) -> object:
    """The scene of the first frame that shows another one than `before`."""
    for _ in range(100):
        scene: object = read_frame(socket)["scene"]
        socket.send("ack")
        if scene != before:
            return scene
    pytest.fail("the scene of the pictures never changed")


def test_a_stalled_viewer_gets_the_newest_later_and_delays_nobody(live: LiveApi) -> None:
    with live_socket(live.address) as stalled, live_socket(live.address) as fast:
        first = read_frame(stalled)
        headers = []
        for _ in range(40):
            headers.append(read_frame(fast))
            fast.send("ack")
        numbers = [header["number"] for header in headers]
        assert numbers == sorted(set(numbers))
        for _ in range(WINDOW - 1):
            last = read_frame(stalled)
        with pytest.raises(TimeoutError):
            stalled.recv(timeout=0.3)  # nothing more is on its way without an acknowledgement
        received = metric(live, "deltalight_live_frames_received_total")
        stalled.send("ack")
        newest = read_frame(stalled)
    assert newest["number"] >= received
    assert newest["skipped"] - last["skipped"] == newest["number"] - last["number"] - 1
    assert newest["skipped"] >= 40 - WINDOW - 1
    assert first["number"] < received


def metric(live: LiveApi, name: str) -> float:
    lines = live.client.get("/metrics").text.splitlines()
    return float(next(line for line in lines if line.startswith(name + " ")).split()[1])


def test_twenty_viewers_all_follow_and_are_counted(live: LiveApi) -> None:
    sent = metric(live, "deltalight_live_frames_sent_total")
    numbers: list[list[int]] = [[] for _ in range(MANY)]

    def watch(socket: ClientConnection, seen: list[int]) -> None:
        for _ in range(15):
            seen.append(read_frame(socket)["number"])
            socket.send("ack")

    with ExitStack() as stack:
        sockets = [stack.enter_context(live_socket(live.address)) for _ in range(MANY)]
        threads = [threading.Thread(target=watch, args=pair) for pair in zip(sockets, numbers, strict=True)]
        for thread in threads:
            thread.start()
        wait_for(lambda: metric(live, "deltalight_live_viewers") == MANY)  # those of earlier tests have left
        for thread in threads:
            thread.join()
    assert all(len(seen) == 15 and seen == sorted(set(seen)) for seen in numbers)
    assert metric(live, "deltalight_live_frames_sent_total") - sent >= 15 * MANY
    assert metric(live, "deltalight_live_frame_age_seconds") >= 0


def test_who_acknowledges_what_it_never_got_is_closed(live: LiveApi) -> None:
    with live_socket(live.address) as socket:
        with suppress(websockets.ConnectionClosed):
            for _ in range(WINDOW + 3):
                socket.send("ack")
        with pytest.raises(websockets.ConnectionClosed) as closed:
            list(iter(lambda: socket.recv(timeout=PATIENCE_S), None))
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1008


@pytest.mark.parametrize("message", ["x" * 2000, b"ack"])
def test_wrong_messages_close_only_their_own_connection(live: LiveApi, message: str | bytes) -> None:
    with live_socket(live.address) as other, live_socket(live.address) as socket:
        socket.send(message)
        with pytest.raises(websockets.ConnectionClosed):
            list(iter(lambda: socket.recv(timeout=PATIENCE_S), None))
        read_frame(other)


@pytest.mark.parametrize("orders", [("codec h264", "codec jpeg"), ("view delta", "view")])
def test_who_changes_view_or_codec_all_the_time_is_closed(live: LiveApi, orders: tuple[str, str]) -> None:
    with live_socket(live.address) as socket, suppress(websockets.ConnectionClosed):
        for _ in range(30):
            for order in orders:
                socket.send(order)
        while True:
            socket.recv(timeout=PATIENCE_S)
    assert socket.protocol.close_code == 1008
    assert "less often" in str(socket.protocol.close_reason)


def test_mjpeg_streams_pictures_and_live_jpg_is_the_newest(live: LiveApi) -> None:
    with httpx.stream("GET", f"http://{live.address}/api/v1/live.mjpg", timeout=PATIENCE_S) as response:
        assert response.headers["content-type"].startswith("multipart/x-mixed-replace")
        received = b""
        for chunk in response.iter_bytes():
            received += chunk
            if received.count(b"--frame") >= 3:
                break
    assert received.count(b"\xff\xd8") >= 2
    newest = live.client.get("/live.jpg")
    assert newest.headers["content-type"] == "image/jpeg"
    assert newest.content[:2] == b"\xff\xd8"


def test_a_pick_is_the_render_servers_answer(live: LiveApi, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = {"frame_id": 5, "kind": "object", "object": "knot", "point_m": [0.1, 0.2, 0.3]}
    seen |= {"normal": [0, 0, 1], "distance_m": 0.9}
    asked: list[dict[str, object]] = []

    def execute(request: ControlRequest) -> dict[str, object]:
        assert request.op == "pick"
        asked.append(dict(request.payload))
        if request.payload["x"] == 1.0:
            raise DeltalightError("No frame was rendered yet.")
        return seen

    monkeypatch.setattr(live.server.session, "execute", execute)
    assert live.client.post("/live/pick", json={"x": 3, "y": 4.5}).json() == seen
    live.client.post("/live/pick", json={"x": 3, "y": 4, "ignore": "knot"}).raise_for_status()
    assert asked == [{"x": 3.0, "y": 4.5}, {"x": 3.0, "y": 4.0, "ignore": "knot"}]
    assert "No frame" in sentence(live.client.post("/live/pick", json={"x": 1, "y": 1}), 422)
    assert "`body.x`" in sentence(live.client.post("/live/pick", json={"x": -1, "y": 1}), 422)


def test_ready_is_more_than_alive(live: LiveApi, tmp_path: Path) -> None:
    assert live.client.get("/ready").json()["stream"]["status"] == "ok"
    with running_api(tmp_path, host="0.0.0.0") as alone:  # no token, no render server, no picture
        assert alone.client.get("/health").status_code == 200
        text = sentence(alone.client.get("/ready"), 503)
        assert "the render server does not answer; no picture came" in text
        assert "storage" not in text


def test_health_tells_of_the_stream(live: LiveApi) -> None:
    stream = live.client.get("/health").json()["stream"]
    assert stream["status"] == "ok"
    assert stream["frame_id"] >= 1
    # The rate is null before the second picture.
    wait_for(lambda: (live.client.get("/health").json()["stream"]["frames_per_s"] or 0) > 5)
    assert LiveHub().state() == ("waiting", None)


# --- who may look -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("open_socket", [live_socket, event_socket])
def test_pages_of_other_sites_open_no_socket(
    live: LiveApi, open_socket: Callable[..., ClientConnection]
) -> None:
    for options in (
        {"origin": websockets.Origin("http://evil.example")},
        {"origin": websockets.Origin("null")},
        {"additional_headers": {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "websocket"}},
    ):
        with pytest.raises(websockets.InvalidStatus) as refused:
            open_socket(live.address, **options)
        assert refused.value.response.status_code == 403
    own = websockets.Origin(f"http://{live.address}")
    with open_socket(live.address, origin=own) as socket:
        socket.recv(timeout=PATIENCE_S)


def test_pictures_are_not_embedded_in_pages_of_other_sites(live: LiveApi) -> None:
    embedded = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}
    assert "other sites" in sentence(live.client.get("/live.jpg", headers=embedded), 403)
    own = {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Dest": "image"}
    assert live.client.get("/live.jpg", headers=own).status_code == 200


def test_a_ticket_lets_in_once_with_the_role_of_its_owner(guarded: LiveApi) -> None:
    with pytest.raises(websockets.InvalidStatus) as refused:
        live_socket(guarded.address)
    assert refused.value.response.status_code == 401
    headers = bearer(guarded, "wall", "view")
    answer = guarded.client.post("/tickets", headers=headers)
    assert answer.status_code == 201
    ticket = answer.json()["ticket"]
    assert answer.json()["expires_s"] == TICKET_LIFE_S
    with event_socket(guarded.address, f"?ticket={ticket}") as socket:
        assert '"role":"view"' in str(socket.recv(timeout=PATIENCE_S))
    for path in (f"/live.jpg?ticket={ticket}", "/live.jpg?ticket=guess", "/live.jpg"):
        sentence(guarded.client.get(path), 401)
    with pytest.raises(websockets.InvalidStatus):
        live_socket(guarded.address, f"?ticket={ticket}")
    picture = guarded.client.post("/tickets", headers=headers).json()["ticket"]
    assert guarded.client.get(f"/live.jpg?ticket={picture}").status_code == 200


def test_a_ticket_neither_changes_anything_nor_makes_another(guarded: LiveApi) -> None:
    headers = bearer(guarded, "boss", "control")
    for path in ("/tickets", "/scenes"):
        ticket = guarded.client.post("/tickets", headers=headers).json()["ticket"]
        sentence(guarded.client.post(f"{path}?ticket={ticket}", json={}), 401)


def test_both_roles_look_and_a_token_works_where_headers_can_be_sent(guarded: LiveApi) -> None:
    for role in ("view", "control"):
        headers = bearer(guarded, f"any-{role}", role)
        with live_socket(guarded.address, additional_headers=headers) as socket:
            read_frame(socket)


def test_tickets_end_and_the_oldest_are_forgotten() -> None:
    now_s = 0.0
    tickets = Tickets(lambda: now_s)
    principal = Principal("view", "id", "wall")
    late, early = tickets.issue(principal), tickets.issue(principal)
    now_s = TICKET_LIFE_S - 1
    assert tickets.redeem(early) == principal
    now_s = TICKET_LIFE_S + 1
    assert tickets.redeem(late) is None
    oldest = tickets.issue(principal)
    for _ in range(OPEN_TICKETS):
        tickets.issue(principal)
    assert tickets.redeem(oldest) is None


def test_a_revoked_token_ends_what_it_opened(guarded: LiveApi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.services.api.limits.CHECK_INTERVAL_S", 0.1)
    headers = bearer(guarded, "guest", "view")
    with live_socket(guarded.address, additional_headers=headers) as socket:
        read_frame(socket)
        guarded.api.store.tokens.revoke("guest")
        with pytest.raises(websockets.ConnectionClosed):
            follow(socket)


def test_a_client_has_only_so_many_places(live: LiveApi) -> None:
    wait_for(lambda: nobody_looks(live))
    with ExitStack() as stack:
        for _ in range(STREAMS_PER_CLIENT):
            stack.enter_context(event_socket(live.address))
        with pytest.raises(websockets.InvalidStatus) as refused:
            event_socket(live.address)
        assert refused.value.response.status_code == 429
        assert "too many live connections" in sentence(live.client.get("/live.mjpg"), 429)
        assert live.client.get("/live.jpg").status_code == 200
    wait_for(lambda: nobody_looks(live))
    with event_socket(live.address) as socket:
        socket.recv(timeout=PATIENCE_S)


def nobody_looks(live: LiveApi) -> bool:
    names = ("deltalight_live_viewers", "deltalight_event_listeners")
    return all(metric(live, name) == 0 for name in names)


# --- the process ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_ctrl_c_ends_the_process_in_spite_of_open_streams_and_it_starts_again(tmp_path: Path) -> None:
    port, control_port, stream_port = ports.private_ports(3)
    stream = StandInStream(stream_port)
    command = [
        sys.executable,
        "-m",
        "deltalight.services.cli",
        "api",
        "--port",
        str(port),
        "--data",
        str(tmp_path),
    ]
    command += ["--control", ports.endpoint(control_port), "--subscribe", ports.endpoint(stream_port)]
    address = f"{ports.LOOPBACK}:{port}"
    for number, expected in ((signal.SIGTERM, ENDED_BY_SIGTERM), (signal.SIGINT, 130)):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        try:
            wait_for_frames(address)
            with (
                live_socket(address) as watched,
                live_socket(address),  # stalled
                event_socket(address),
                httpx.stream("GET", f"http://{address}/api/v1/live.mjpg", timeout=PATIENCE_S),
            ):
                read_frame(watched)
                process.send_signal(number)
                _, errors = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
        assert process.returncode == expected
        assert "Traceback" not in errors
        assert "Cancel" not in errors  # nothing had to be ended by force
    stream.close()
    assert ports.is_free(port)
