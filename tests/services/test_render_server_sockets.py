"""The render server behind real sockets, with a renderer that the test gives: changes, sources, long scenes."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from deltalight.protocol.envelope import decode
from deltalight.protocol.messages import (
    CompositeMessage,
    ControlReply,
    ControlRequest,
    ProcessState,
    StatsMessage,
)
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import RequestClient
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import ShownView
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.gpu.context import CompileWatcher
from deltalight.render_server.server import process
from deltalight.render_server.server.process import ServerSettings, serve
from deltalight.services import ports
from deltalight.services.api.streams import ProcessWatch
from tests.services.api_samples import UPLOAD, running_api
from tests.services.conftest import camera, color, depth, pose
from tests.services.render_server_samples import InvertingRenderer, Started
from tests.services.storage_samples import TETRAHEDRON

FRAMES_PER_S = 100
PATIENCE_S = 60.0


class Node:
    """Publishes numbered frames as `name` until it is closed; `newest` is the last number sent."""

    def __init__(
        self, endpoint: str, first: int = 0, name: str = "cam", frames_per_s: float = FRAMES_PER_S
    ) -> None:
        self.newest, self._name, self._period_s = first, name, 1 / frames_per_s
        self._publisher = Publisher(endpoint)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(first,), daemon=True)
        self._thread.start()

    def _run(self, first: int) -> None:
        for number in itertools.count(first):
            if self._closed.wait(self._period_s):
                return
            self.newest = number
            for message in (color, depth, pose):
                self._publisher.send(message(number, number, node=self._name))

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        self._publisher.close()


class Server:
    """A render server in a thread, its control client, and a receiver of what it publishes."""

    def __init__(
        self,
        renderer: InvertingRenderer,
        node_port: int,
        compile_watchers: list[CompileWatcher] | None = None,
        **settings: object,
    ) -> None:
        self.control, self.published = map(ports.endpoint, ports.private_ports(2))
        scene = SceneDocument(revision=7)
        self._settings = ServerSettings.model_validate(
            {
                "subscribe": [ports.endpoint(node_port)],
                "publish": self.published,
                "control": self.control,
                **settings,
            }
        )
        self._thread = threading.Thread(
            target=serve,
            args=(self._settings, renderer, scene),
            kwargs={"renderer_name": "abacus", "compile_watchers": compile_watchers},
            daemon=True,
        )
        self._thread.start()
        self.client = RequestClient(self.control)
        self.receiver = Receiver([self.published], ["composite"])

    def ask(self, op: str, **payload: object) -> ControlReply:
        request = ControlRequest(node="test", id=f"r{time.time_ns()}", op=op, payload=payload)
        return self.client.request(request, PATIENCE_S)

    def composites(self) -> Iterator[CompositeMessage]:
        """What comes, newest first where several wait."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            for multipart in (self.receiver.latest(1.0) or {}).values():
                message, _ = decode(multipart)
                assert isinstance(message, CompositeMessage)
                yield message
        pytest.fail("no such composite came")

    def first(self, wanted: Callable[[CompositeMessage], bool]) -> CompositeMessage:
        return next(message for message in self.composites() if wanted(message))

    def close(self) -> None:
        assert self.ask("shutdown").ok
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        self.client.close()
        self.receiver.close()


@contextmanager
def serving(
    renderer: InvertingRenderer | None = None,
    compile_watchers: list[CompileWatcher] | None = None,
    *,
    immediate: bool = True,
    **settings: object,
) -> Iterator[tuple[Server, InvertingRenderer, int]]:
    renderer = renderer or InvertingRenderer()
    renderer.immediate = immediate
    (node_port,) = ports.private_ports(1)
    server = Server(renderer, node_port, compile_watchers, **settings)
    try:
        yield server, renderer, node_port
    finally:
        server.close()


def behind(frame_id: int) -> Callable[[CompositeMessage], bool]:
    return lambda message: message.frame_id > frame_id


@pytest.mark.parametrize("immediate", [True, False], ids=["software", "gpu"])
def test_a_rest_change_is_in_the_first_picture_that_is_begun_after_its_answer(
    tmp_path: Path, immediate: bool
) -> None:
    with serving(immediate=immediate) as (server, renderer, node_port):
        node = Node(ports.endpoint(node_port))
        with running_api(tmp_path, control=server.control) as api:
            api.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD).raise_for_status()
            made = api.client.post("/scenes", json={"objects": [{"asset": "t.obj", "id": "cup"}]}).json()
            api.client.post(f"/scenes/{made['id']}/activate").raise_for_status()
            server.first(lambda message: message.status == "ok")
            for height in range(10):
                changed = api.client.patch(
                    f"/scenes/{made['id']}/objects/cup", json={"pose": {"translation_m": [0, 0, height]}}
                )
                begun = node.newest  # a frame sent from now on cannot have been begun before the answer
                assert changed.json()["picture"]["state"] == "shown"
                shown = server.ask("ping").payload
                assert renderer.scenes[-1].objects[0].pose.translation_m[2] == height
                later = server.first(behind(begun))
                assert (shown["scene_id"], shown["revision"]) == (made["id"], changed.json()["revision"])
                assert (later.scene_id, later.scene_revision) == (made["id"], changed.json()["revision"])
        node.close()


def test_a_scene_of_a_thousand_objects_passes_both_ways(tmp_path: Path) -> None:
    objects = [{"asset": "t.obj", "id": f"object {number}"} for number in range(1000)]
    with (
        serving(session=tmp_path / "session.json") as (server, renderer, _),
        running_api(tmp_path, control=server.control) as api,
    ):
        api.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD).raise_for_status()
        made = api.client.post("/scenes", json={"objects": objects}).json()
        picture = api.client.post(f"/scenes/{made['id']}/activate").json()["picture"]
        deadline_s = time.monotonic() + PATIENCE_S
        while picture["state"] == "pending" and time.monotonic() < deadline_s:  # a busy machine answers later
            time.sleep(0.05)
            picture = api.client.get("/active-scene").json()["picture"]
        assert picture["state"] == "shown"
        assert len(renderer.scenes[-1].objects) == 1000
        scene = server.ask("get_scene").payload["scene"]
        assert isinstance(scene, dict)
        assert [item["id"] for item in scene["objects"]] == [item["id"] for item in objects]


def test_another_source_is_read_at_once_and_the_old_one_never_shows_again() -> None:
    (other_port,) = ports.private_ports(1)
    with serving(immediate=False) as (server, renderer, node_port):
        here, there = Node(ports.endpoint(node_port)), Node(ports.endpoint(other_port), first=10**6)
        server.first(lambda message: message.frame_id > 5)
        drops = server.first(lambda _: True).drops
        lost = sum(count for name, count in drops.items() if name.endswith(".cam"))
        assert server.ask("set_source", endpoints=[ports.endpoint(other_port)]).payload == {
            "endpoints": [ports.endpoint(other_port)]
        }
        server.first(lambda message: message.frame_id >= 10**6)  # what was on its way came before
        seen = list(itertools.islice(server.composites(), 20))
        assert all(message.frame_id >= 10**6 for message in seen)
        assert seen[-1].drops.get("earlier_sources", 0) >= lost
        assert seen[-1].drops.get("superseded", 0) >= drops.get("superseded", 0)
        assert renderer.sources_begun == 1
        assert server.ask("set_source", endpoints=[ports.endpoint(other_port)]).ok
        assert renderer.sources_begun == 1  # the same again changes nothing
        for wrong in ("tcp://192.0.2.1:5", "http://127.0.0.1:5", "nonsense"):
            refused = server.ask("set_source", endpoints=[wrong])
            assert wrong in str(refused.error)
        assert server.first(lambda _: True).frame_id >= 10**6  # refusals change nothing
        back = server.ask("set_source", endpoints=None)
        assert back.payload == {"endpoints": [ports.endpoint(node_port)]}
        server.first(lambda message: message.frame_id < 10**6)
        assert all(message.frame_id < 10**6 for message in itertools.islice(server.composites(), 20))
        here.close()
        there.close()


def test_a_faulty_node_does_not_end_the_server() -> None:
    with serving() as (server, _, node_port):
        faulty = Publisher(ports.endpoint(node_port))
        wrong = {**camera().to_dict(), "distortion_model": "w" * 5000}
        while "bad_frames" not in server.ask("stats").payload["stats"]["drops"]:  # type: ignore[index]
            for number in range(140):
                faulty.send([f"color.{number:03}{'x' * 110}".encode(), b"no header"])
            for message in (color(1, 1, 0, wrong), depth(1, 1), pose(1, 1)):
                faulty.send(message)
        faulty.close()
        node = Node(ports.endpoint(node_port), first=2)
        assert server.first(lambda message: message.frame_id >= 2).status == "ok"
        node.close()


def test_a_degraded_state_is_shown_logged_once_and_counted(tmp_path: Path) -> None:
    wrong = {**camera().to_dict(), "distortion_model": "unheard of"}
    numbers = itertools.count(1)
    with (
        capture_logs() as lines,
        serving() as (server, _, node_port),
        running_api(tmp_path, control=server.control, subscribe=[server.published]) as api,
        closing(Publisher(ports.endpoint(node_port))) as node,
    ):

        def shown_when(state: str, own: dict[str, object] | None) -> dict[str, Any]:
            """Sends frames with that camera until the web process shows that state of the render server."""
            deadline_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline_s:
                number = next(numbers)
                for message in (color(number, number, 0, own), depth(number, number), pose(number, number)):
                    node.send(message)
                known = {each["name"]: each for each in api.client.get("/nodes").json()}
                if known.get("render-server", {}).get("state") == state:
                    return dict(known["render-server"])
                time.sleep(0.01)
            pytest.fail(f"never {state}")

        shown_when("running", None)
        degraded = shown_when("degraded", wrong)
        assert "unheard of" in degraded["detail"]
        assert api.client.get("/health").json()["status"] == "ok", "it works, and needs no restart"
        after = shown_when("running", None)
        assert "unheard of" not in after["detail"]
        counts = api.client.get("/metrics").text.splitlines()
    assert 'deltalight_process_degraded_total{process="render-server"} 1.0' in counts
    assert after["drops"]["bad_frames"] > 1
    told = [(each["event"], each["log_level"]) for each in lines if "degraded" in each["event"]]
    assert told == [("a process is degraded", "warning"), ("a process is no longer degraded", "info")]
    assert sum(each["event"] == "bad_frames" for each in lines) == 1, "the render server's own line"


def test_a_state_that_comes_and_goes_is_counted_each_time_and_logged_once() -> None:
    watch = ProcessWatch()
    with capture_logs() as lines:
        for number in range(40):
            state: ProcessState = "degraded" if number % 4 < 2 else "running"
            report = watch.note(StatsMessage(node="cam", capture_ns=number, state=state, detail="board"))
    assert report.degraded == 10
    assert [each["event"] for each in lines] == ["a process is degraded", "a process is no longer degraded"]


class CompilingRenderer(InvertingRenderer):
    """Compiles two shaders for its first picture, the second once `released`."""

    def __init__(self) -> None:
        super().__init__()
        self.watchers: list[CompileWatcher] = []
        self.released = threading.Event()

    def submit_cameras(
        self,
        taken: Sequence[CameraFrame],
        *,
        with_linear: bool = False,
        full_size: bool = False,
        others: Sequence[ShownView] = (),
    ) -> list[Started]:
        for label in ("clear", "shade"):
            for watch in self.watchers:
                watch(label, {})
            self.released.wait(PATIENCE_S)
        return super().submit_cameras(taken, with_linear=with_linear, full_size=full_size, others=others)


def test_how_far_a_first_picture_is_comes_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "PREPARING_INTERVAL_S", 0.0)
    renderer = CompilingRenderer()
    with serving(renderer, renderer.watchers) as (server, _, node_port):
        receiver, node = Receiver([server.published], ["stats"]), Node(ports.endpoint(node_port))
        states = []
        while "starting" not in states:
            messages = [decode(each)[0] for each in (receiver.latest(PATIENCE_S) or {}).values()]
            states += [message.state for message in messages if isinstance(message, StatsMessage)]
        renderer.released.set()
        assert server.first(lambda message: message.status == "ok")
        node.close()
        receiver.close()


def test_a_server_compiles_ahead_between_pictures() -> None:
    with serving(immediate=False) as (server, renderer, node_port):
        node = Node(ports.endpoint(node_port))
        before = server.first(lambda message: message.status == "ok"), renderer.compiled_ahead
        server.first(lambda message: message.frame_id > before[0].frame_id)
        assert renderer.compiled_ahead > before[1]
        node.close()


def test_frames_go_on_after_a_snapshot_and_commands_wait_for_it(tmp_path: Path) -> None:
    with serving(immediate=False) as (server, _, node_port):
        node = Node(ports.endpoint(node_port))
        server.first(lambda message: message.status == "ok")
        pictures = [{"name": f"p{number}", "view": "delta"} for number in range(5)]
        answers = [
            server.ask("snapshot", folder=str(tmp_path), pictures=pictures, exr=True) for _ in range(3)
        ]
        for answer in answers:
            assert answer.error is None
            assert len(answer.payload["files"]) == 6  # type: ignore[arg-type]
            assert answer.payload["errors"] == {}
        after = server.first(lambda message: message.frame_id > node.newest - 2)
        assert (after.scene_id, after.scene_revision) == (None, 7)
        assert len(list(tmp_path.iterdir())) == 6
        node.close()
