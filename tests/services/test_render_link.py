"""Changes that come faster than the renderer takes them: the newest wins, and nobody else waits for it."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from deltalight.services import ports
from deltalight.services.api import delivery, render_link
from deltalight.services.api.delivery import BUSY, WAITERS, Change, Deliveries, DeliveryStatus
from deltalight.services.api.render_link import FifoLock
from deltalight.services.api.routes import live
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.live_samples import event_socket, live_socket, next_event
from tests.services.render_server_samples import Recorder
from tests.services.test_api_scenes import wait_for

LONG_S, SHORT_S = 25.0, 0.05
THREADS = 8  # that may wait for the render server
MANY = 60  # more than there are threads that answer requests


class Shown:
    """A scene that is shown by a stand-in render server, and clients that do things at once."""

    def __init__(self, api: RunningApi, server: Recorder) -> None:
        self.client = api.client
        self.address = f"127.0.0.1:{api.client.base_url.port}"
        self.server = server
        wait_for(lambda: self.client.get("/state").json()["render_server"] == "answers")
        self.id = self.client.post("/scenes", json={"name": "first"}).json()["id"]
        assert self.activate()["picture"]["state"] == "shown"
        self.waiting = api.app.state.context.pools["render server"]  # type: ignore[attr-defined]
        self._pool = ThreadPoolExecutor(MANY)

    def rename(self, name: str) -> dict[str, Any]:
        answer = self.client.patch(f"/scenes/{self.id}", json={"name": name})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def activate(self) -> dict[str, Any]:
        return dict(self.client.post(f"/scenes/{self.id}/activate").raise_for_status().json())

    def pick(self) -> httpx.Response:
        return self.client.post("/live/pick", json={"x": 0, "y": 0})

    def at_once(self, work: Callable[[], Any]) -> Future[Any]:
        return self._pool.submit(work)

    def hold_up(self) -> Future[dict[str, Any]]:
        """A change that the renderer is at until the gate opens."""
        self.server.gate.clear()
        held = self.at_once(lambda: self.rename("held up"))
        assert self.server.is_busy.wait(LONG_S)
        return held

    def names_sent(self) -> list[object]:
        return [order["scene"]["name"] for order in self.server.payloads("set_scene")]

    def close(self) -> None:
        self.server.gate.set()
        self._pool.shutdown()


@pytest.fixture
def wait_s(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Sets how long an answer waits for the renderer."""
    return lambda seconds: monkeypatch.setattr(delivery, "WAIT_S", seconds)


@pytest.fixture
def shown(
    tmp_path: Path, wait_s: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Shown]:
    """However busy this machine is, nothing here is due to a time that passed."""
    wait_s(LONG_S)
    monkeypatch.setattr(render_link, "ALIVE_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(live, "PICK_TIMEOUT_S", LONG_S)
    (control_port,) = ports.private_ports(1)
    with (
        closing(Recorder(control_port)) as server,  # after the API, which would wait for its last answer
        running_api(tmp_path, control=ports.endpoint(control_port)) as api,
    ):
        shown = Shown(api, server)
        try:
            yield shown
        finally:
            shown.close()


def test_the_newest_of_many_changes_is_sent_and_all_are_answered(shown: Shown) -> None:
    held = shown.hold_up()
    many = [shown.at_once(partial(shown.rename, f"change {n}")) for n in range(MANY)]
    wait_for(lambda: sum(each.done() for each in many) == MANY - 1)
    for path in ("/state", "/scenes", f"/scenes/{shown.id}", "/health"):
        assert shown.client.get(path).status_code == 200, "while the renderer is stuck"
    assert held.result(0)["picture"]["state"] == "superseded"
    (newest,) = (each for each in many if not each.done())
    early = [each.result()["picture"] for each in many if each is not newest]
    assert {picture["state"] for picture in early} == {"superseded"}
    assert sorted(picture["revision"] for picture in early) == list(range(3, MANY + 2))

    shown.server.gate.set()
    last = newest.result(LONG_S)
    assert last["picture"] == {"state": "shown", "revision": MANY + 2, "detail": ""}
    assert shown.names_sent() == ["first", "held up", last["document"]["name"]]
    assert shown.client.get("/state").json()["picture"] == last["picture"]


def test_a_scene_that_another_web_process_was_ahead_of_is_not_refused(shown: Shown) -> None:
    shown.rename("second")
    shown.server.refusal, shown.server.revision = "The scene is already at revision 4.", 4
    picture = shown.rename("third")["picture"]
    assert (picture["state"], picture["revision"]) == ("pending", 3)
    shown.server.refusal = None
    wait_for(lambda: shown.client.get("/state").json()["picture"]["state"] == "shown")
    shown.server.refusal = "It cannot be shown."
    refused = shown.rename("fourth")["picture"]
    assert (refused["state"], refused["detail"]) == ("refused", "It cannot be shown.")


def test_the_views_that_viewers_look_at_are_ordered_and_no_change_of_the_scene(shown: Shown) -> None:
    def watched() -> list[object]:
        return [order["views"] for order in shown.server.payloads("watch")]

    before, sent = shown.client.get(f"/scenes/{shown.id}").json(), len(shown.server.payloads("set_scene"))
    wait_for(lambda: watched() == [[]])
    with live_socket(shown.address, "?view=delta"), live_socket(shown.address) as other:
        wait_for(lambda: watched()[1:] == [["delta"]])
        other.send("view rsm")
        wait_for(lambda: watched()[2:] == [["delta", "rsm"]])
    wait_for(lambda: watched()[-1] == [])
    assert len(shown.server.payloads("set_scene")) == sent
    assert shown.client.get(f"/scenes/{shown.id}").json() == before
    assert not before["can_undo"]


def test_a_restarted_render_server_is_told_again_which_views_are_looked_at(shown: Shown) -> None:
    with live_socket(shown.address, "?view=delta"):
        wait_for(lambda: {"views": ["delta"]} in shown.server.payloads("watch"))
        before = len(shown.server.payloads("watch"))
        shown.server.instance = "another"
        wait_for(lambda: shown.server.payloads("watch")[before:] == [{"views": ["delta"]}])


def test_who_waits_for_the_same_revision_holds_a_few_threads_only(shown: Shown) -> None:
    held = shown.hold_up()
    others = [shown.at_once(shown.activate) for _ in range(MANY - 1)]
    wait_for(lambda: sum(each.done() for each in others) >= MANY - WAITERS)
    assert shown.client.get("/scenes").status_code == 200
    shown.server.gate.set()
    states = [each.result(LONG_S)["picture"]["state"] for each in (held, *others)]
    assert states.count("shown") == WAITERS
    assert states.count("pending") == MANY - WAITERS


def test_a_slow_renderer_is_answered_as_pending_and_heard_of_later(
    shown: Shown, wait_s: Callable[[float], None]
) -> None:
    wait_s(SHORT_S)
    shown.server.gate.clear()
    with event_socket(shown.address) as socket:
        answer = shown.rename("takes long")
        assert answer["picture"] == {"state": "pending", "revision": 2, "detail": BUSY}
        shown.server.gate.set()
        heard = next_event(socket, "picture", timeout_s=LONG_S)
    assert (heard["scene_id"], heard["revision"], heard["state"]) == (shown.id, 2, "shown")


def test_a_scene_that_became_active_while_the_renderer_is_busy_is_pending(
    shown: Shown, wait_s: Callable[[float], None]
) -> None:
    other = shown.client.post("/scenes", json={"name": "other"}).json()["id"]
    held = shown.hold_up()
    wait_s(SHORT_S)
    expected = {"state": "pending", "revision": 1, "detail": BUSY}
    assert shown.client.post(f"/scenes/{other}/activate").json()["picture"] == expected
    assert shown.client.get("/active-scene").json()["picture"] == expected
    shown.server.gate.set()
    held.result(LONG_S)


def test_another_scene_takes_the_place_of_a_change_that_waits(shown: Shown) -> None:
    other = shown.client.post("/scenes", json={"name": "other"}).json()["id"]
    held = shown.hold_up()
    waiting = shown.at_once(lambda: shown.rename("never seen"))
    assert held.result(LONG_S)["picture"]["state"] == "superseded"
    activated = shown.at_once(lambda: shown.client.post(f"/scenes/{other}/activate").json())
    wait_for(lambda: shown.client.get("/active-scene").json()["id"] == other)
    shown.server.gate.set()
    assert activated.result(LONG_S)["picture"] == {"state": "shown", "revision": 1, "detail": ""}
    assert waiting.result(LONG_S)["picture"]["state"] == "superseded"
    assert shown.names_sent() == ["first", "held up", "other"]


def test_a_command_comes_after_the_changes_before_it(shown: Shown, wait_s: Callable[[float], None]) -> None:
    shown.hold_up()
    wait_s(SHORT_S)
    shown.rename("before the pick")
    picked = shown.at_once(shown.pick)
    shown.server.gate.set()
    assert picked.result(LONG_S).status_code == 200
    asked = [op for op, _ in shown.server.asked if op in ("set_scene", "pick")]
    assert asked == ["set_scene"] * 3 + ["pick"]


def test_changes_without_end_leave_commands_their_turn(shown: Shown) -> None:
    ended = threading.Event()

    def change_on() -> None:
        while not ended.is_set():
            shown.rename(f"{threading.get_ident()}")

    busy = [shown.at_once(change_on) for _ in range(4)]
    try:
        for _ in range(5):
            assert shown.pick().status_code == 200
            assert shown.client.post("/snapshots", json={"pictures": [{"name": "a"}]}).status_code == 201
    finally:
        ended.set()
    for each in busy:
        each.result(LONG_S)


def test_commands_that_wait_are_limited_and_requests_go_on(shown: Shown) -> None:
    shown.waiting.patience_s = 1.0
    shown.server.gate.clear()
    picks = [shown.at_once(shown.pick) for _ in range(MANY)]
    wait_for(lambda: any(each.done() for each in picks))
    assert shown.client.get("/scenes").status_code == 200
    wait_for(lambda: sum(each.done() for each in picks) == MANY - THREADS)
    shown.server.gate.set()
    answers = [each.result(LONG_S) for each in picks]
    refused = [answer for answer in answers if answer.status_code != 200]
    assert len(refused) == MANY - THREADS
    assert all("wait for the render server" in sentence(answer, 503) for answer in refused)
    assert all(answer.headers["Retry-After"] == "1" for answer in refused)


def test_older_changes_are_superseded_in_whatever_order_they_are_told() -> None:
    known = Deliveries()
    newer, older = Change("a", 6), Change("a", 5)
    outcome = known.expect(newer)
    assert known.expect(older).result(0).state == "superseded"
    other = known.expect(Change("b", 1))
    assert not other.done()
    shown = DeliveryStatus("shown", "a", 6)
    known.note(shown, known.awaited)
    assert outcome.result(0) == known.newest == shown
    assert other.result(0).state == "superseded", "the scene that is shown is another one"
    assert known.expect(older).result(0).state == "superseded"
    assert not known.expect(newer).done(), "it is looked again whether the server still has it"


def test_the_lock_is_held_in_the_order_of_arrival() -> None:
    lock, order = FifoLock(), list[int]()

    def are_waiting(count: int) -> bool:
        return len(lock._waiting) == count

    def take(number: int) -> None:
        with lock:
            order.append(number)

    with lock:
        threads = []
        for number in range(5):
            threads.append(threading.Thread(target=take, args=(number,)))
            threads[-1].start()
            wait_for(partial(are_waiting, number + 1))
    for thread in threads:
        thread.join()
    assert order == list(range(5))
    with lock:  # free again
        pass
