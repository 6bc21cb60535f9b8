"""Events: who changed what, heard by every client; a slow one loses the oldest and is told."""

import asyncio
import json
import threading
from collections.abc import Iterator
from datetime import UTC, datetime

import pytest
import websockets

from deltalight.protocol.envelope import encode
from deltalight.services.api.events import QUEUE_EVENTS, EventHub
from tests.services.api_samples import UPLOAD, RenderServer
from tests.services.live_samples import PATIENCE_S, LiveApi, event_socket, live_api, next_event, report
from tests.services.storage_samples import TETRAHEDRON
from tests.services.test_api_scenes import wait_for


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, module_database: str | None) -> Iterator[LiveApi]:
    with live_api(tmp_path_factory.mktemp("data"), database=module_database) as running:
        yield running


@pytest.fixture
def live(shared: LiveApi) -> LiveApi:
    """With a render server that answers."""
    wait_for(lambda: shared.client.get("/state").json()["render_server"] == "answers")
    return shared


def test_a_client_is_greeted_and_hears_every_change_of_scenes(live: LiveApi) -> None:
    client = live.client
    with event_socket(live.address) as socket, event_socket(live.address) as other:
        hello = next_event(socket, "hello")
        assert hello["role"] == "control"
        assert hello["version"]
        scene_id = client.post("/scenes", json={"name": "room"}).json()["id"]
        made = {"type": "scene", "id": scene_id, "revision": 1, "name": "room", "what": "created"}
        assert next_event(socket, "scene") == {**made, "active": False}
        assert next_event(other, "scene")["id"] == scene_id
        client.post(f"/scenes/{scene_id}/activate")
        assert next_event(socket, "scene")["active"] is True
        client.patch(f"/scenes/{scene_id}/output", json={"view": "delta"})
        changed = next_event(socket, "scene")
        assert (changed["revision"], changed["what"]) == (2, "output: view changed")
        picture = next_event(socket, "picture")
        while picture["revision"] < 2:
            picture = next_event(socket, "picture")
        assert picture["state"] == "shown"
        assert picture["scene_id"] == scene_id
        client.post(f"/scenes/{scene_id}/undo")
        assert next_event(socket, "scene")["what"] == "undo"
        copied = client.post(f"/scenes/{scene_id}/duplicate").json()["id"]
        assert next_event(socket, "scene")["id"] == copied
        client.delete(f"/scenes/{copied}")
        assert next_event(socket, "scene")["deleted"] is True


def test_refused_pictures_are_heard(live: LiveApi) -> None:
    client = live.client
    with event_socket(live.address) as socket:
        scene_id = client.post("/scenes", json={"name": "refused"}).json()["id"]
        client.post(f"/scenes/{scene_id}/activate")
        refused = next_event(socket, "picture")
        while refused["scene_id"] != scene_id:
            refused = next_event(socket, "picture")
    assert refused["state"] == "refused"
    assert "cannot be shown" in refused["detail"]


def test_uploads_and_deleted_assets_are_heard(live: LiveApi) -> None:
    with event_socket(live.address) as socket:
        answer = live.client.post("/assets", params={"name": "a.obj"}, content=TETRAHEDRON, headers=UPLOAD)
        digest = answer.json()["asset"]
        assert next_event(socket, "asset") == {"type": "asset", "digest": digest, "name": "a.obj"}
        live.client.delete(f"/assets/{digest}")
        assert next_event(socket, "asset")["deleted"] is True


def test_reports_of_processes_are_heard_and_listed_as_nodes(live: LiveApi) -> None:
    with event_socket(live.address) as socket:
        heard = next_event(socket, "process")
        assert heard["name"] == "render-server"
        message = report("desk", "two cameras", rates={"fps": 15.0}, clock_offset_ns=-3_000_000)
        live.stream.publisher.send(encode(message.model_copy(update={"clock_bound_ns": 500_000})))
        while heard["name"] != "desk":
            heard = next_event(socket, "process")
    assert heard["detail"] == "two cameras"
    nodes = {each["name"]: each for each in live.client.get("/nodes").json()}
    desk, server = nodes["desk"], nodes["render-server"]
    assert (desk["kind"], server["kind"]) == ("node", "render_server")
    assert desk["rates"] == {"fps": 15.0}
    assert (desk["clock_offset_ms"], desk["clock_bound_ms"]) == (-3.0, 0.5)
    assert desk["delays_ms"]["report"] >= 3
    assert server["delays_ms"]["capture_to_server"] == 3.0
    assert server["delays_ms"]["rendering"] == 2.0
    assert server["delays_ms"]["server_to_api"] >= 0


def test_a_silent_render_server_is_heard_as_pending(live: LiveApi) -> None:
    client = live.client
    scene_id = client.post("/scenes", json={"name": "later"}).json()["id"]
    client.post(f"/scenes/{scene_id}/activate")
    live.server.close()
    with event_socket(live.address) as socket:
        client.patch(f"/scenes/{scene_id}", json={"name": "later still"})
        assert next_event(socket, "picture")["state"] == "pending"
        again = RenderServer(live.control_port)
        try:
            shown = next_event(socket, "picture")
        finally:
            again.close()
            live.server.open()
    assert (shown["state"], shown["revision"]) == ("shown", 2)


def test_who_sends_something_is_closed(live: LiveApi) -> None:
    with event_socket(live.address) as socket:
        socket.send("hello?")
        with pytest.raises(websockets.ConnectionClosed):
            list(iter(lambda: socket.recv(timeout=PATIENCE_S), None))


def test_a_slow_client_loses_the_oldest_and_is_told_how_many() -> None:
    async def listen() -> list[dict[str, object]]:
        hub = EventHub()
        with hub.listening() as slow, hub.listening() as quick:
            assert hub.listeners == 2
            for number in range(QUEUE_EVENTS + 5):
                hub.publish("notice", {"text": str(number)})
                assert json.loads(await quick.next())["text"] == str(number)
            heard = [json.loads(await slow.next()) for _ in range(QUEUE_EVENTS + 1)]
        assert hub.listeners == 0
        return heard

    heard = asyncio.run(listen())
    assert heard[0] == {"type": "lost", "count": 5}
    assert [event["text"] for event in heard[1:]] == [str(n) for n in range(5, QUEUE_EVENTS + 5)]


def test_events_come_from_any_thread_and_hold_what_json_can_say() -> None:
    async def listen() -> dict[str, object]:
        hub = EventHub()
        hub.publish("notice", {"text": "nobody hears this"})
        body = {"at": datetime(2026, 1, 2, tzinfo=UTC), "rate": float("nan")}
        with hub.listening() as queue:
            threading.Timer(0.05, hub.publish, ("recording", body)).start()
            event: dict[str, object] = json.loads(await asyncio.wait_for(queue.next(), 30))
            return event

    assert asyncio.run(listen()) == {"type": "recording", "at": "2026-01-02T00:00:00Z", "rate": None}
