"""A spare render server that has built the scene ahead, with real processes: who is killed comes back with it."""

import os
import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from pathlib import Path
from unittest.mock import Mock, patch

import psutil
import pytest

from deltalight.protocol.envelope import decode
from deltalight.protocol.messages import CompositeMessage, ControlReply, ControlRequest
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import RequestClient
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.server.cameras import RoomCameras
from deltalight.render_server.server.pace import CalledError
from deltalight.render_server.server.process import ServerSettings
from deltalight.render_server.server.standby import ANSWER_TIMEOUT_S, StandbyRenderer, _assets, _Built, _stamp
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.supervisor import Supervisor
from deltalight.services.warm_spare import PREPARED
from tests.services.storage_samples import TETRAHEDRON
from tests.services.test_render_server_sockets import Node

pytestmark = pytest.mark.slow(seconds=20)
PATIENCE_S = 90.0
FRAMES_PER_S = 10  # real renderers draw them all
SERVER = "render server"
USES_IT = "goes on with the scene that was built ahead"
COMMAND_LINE = "from deltalight.services.cli import main\nmain()"
WITHOUT_MEMORY = f"""
from deltalight.render_server.server import standby
standby.NEEDED_BYTES = 2**62
{COMMAND_LINE}
"""


class Station:
    """A render server of a scene with one object, its spare, a node and a receiver of its pictures."""

    def __init__(self, folder: Path, code: str) -> None:
        node_port, published, control = ports.private_ports(3)
        self.lines: list[str] = []
        self.document = scene(folder)
        session = folder / "session.json"
        session.write_text(self.document.model_dump_json())
        options = ["--session", str(session), "--subscribe", ports.endpoint(node_port), "--allow-software"]
        sockets = ["--publish", ports.endpoint(published), "--control", ports.endpoint(control)]
        arguments = ("-P", "-c", code, "server", *options, *sockets)
        spec = ChildSpec(SERVER, arguments, warm=PREPARED["server"], rehearsed=True)
        self.supervisor = Supervisor([spec], forward=self.lines.append)
        self._node = Node(ports.endpoint(node_port), frames_per_s=FRAMES_PER_S)
        self._receiver = Receiver([ports.endpoint(published)], ["composite"])
        self._client = RequestClient(ports.endpoint(control))
        self._heard = ""

    def close(self) -> None:
        self.supervisor.stop()
        self._node.close()
        self._receiver.close()
        self._client.close()

    def wait_for(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        self.supervisor.run(until=lambda: condition() or time.monotonic() > deadline_s)
        assert condition(), self.lines

    def wait_for_spare_to_say(self, words: str) -> None:
        """The spare's lines are read by nobody else before it takes over."""
        (child,) = self.supervisor._children

        def said() -> bool:
            if child.spare is not None and child.spare.stderr is not None:
                stderr = child.spare.stderr.fileno()
                if select.select([stderr], [], [], 0)[0]:
                    self._heard += os.read(stderr, 65536).decode()
            return words in self._heard

        self.wait_for(said)

    def kill(self) -> None:
        """Kills the server, and waits until its spare has taken over and shows a picture."""
        spare, now_ns = self.supervisor.spare_ids()[SERVER], time.time_ns()
        psutil.Process(self.supervisor.process_ids()[SERVER]).kill()
        self.wait_for(lambda: self.supervisor.process_ids()[SERVER] == spare)
        self.wait_for(lambda: self.picture().rendered_ns > now_ns)

    def picture(self) -> CompositeMessage:
        messages = [decode(each)[0] for each in (self._receiver.latest(1.0) or {}).values()]
        found = [message for message in messages if isinstance(message, CompositeMessage)]
        return found[0] if found else CompositeMessage.model_construct(rendered_ns=0, scene_revision=0)

    def ask(self, op: str, **payload: object) -> ControlReply:
        request = ControlRequest(node="test", id=f"r{time.time_ns()}", op=op, payload=payload)
        return self._client.request(request, PATIENCE_S)

    def move_cup(self) -> None:
        changed = self.document.model_dump(mode="json")
        changed["objects"][0]["pose"]["translation_m"] = [0.1, 0, 0.5]
        assert self.ask("set_scene", scene=changed).ok

    def shown(self) -> SceneDocument:
        found = self.ask("get_scene").payload["scene"]
        assert isinstance(found, dict)
        return parse_scene(found)


def scene(folder: Path) -> SceneDocument:
    mesh = folder / "cup.obj"
    mesh.write_bytes(TETRAHEDRON)
    return parse_scene(
        {
            "revision": 7,
            "objects": [
                {"id": "cup", "asset": str(mesh), "pose": {"translation_m": [0, 0, 0.5], "scale": 0.2}}
            ],
            "method": {"name": "dvct", "volume_size": 32, "cone_count": 4, "bounces": 0, "far_volume": False},
        }
    )


@pytest.fixture
def station_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Station]]:
    monkeypatch.setattr("deltalight.services.child.SPARE_AFTER_S", 0.0)
    opened: list[Station] = []

    def station(code: str) -> Station:
        opened.append(Station(tmp_path, code))
        opened[-1].supervisor.__enter__()
        return opened[-1]

    yield station
    for each in opened:
        with closing(each):
            pass


def test_a_spare_waits_for_a_frame_of_each_camera_longer_than_a_server_would() -> None:
    one, other, published, control = map(ports.endpoint, ports.private_ports(4))
    settings = ServerSettings(subscribe=(one, other), publish=published, control=control)
    cameras = RoomCameras(None, lambda error: pytest.fail(str(error)), needs_depth=False, endpoints=2)
    nodes = [Node(one, name="left")]
    late = threading.Timer(1.0, lambda: nodes.append(Node(other, name="right")))
    late.start()
    try:
        taken = StandbyRenderer(settings, None, lambda _timeout_s: False)._listen(cameras)
    finally:
        late.join()
        for node in nodes:
            node.close()
    assert [each.camera for each in taken] == ["left", "right"]


def test_a_spare_that_is_called_waits_for_no_answer_of_the_dead_server() -> None:
    node, published, control = map(ports.endpoint, ports.private_ports(3))
    settings = ServerSettings(subscribe=(node,), publish=published, control=control)
    began_s = time.monotonic()
    ahead = StandbyRenderer(settings, None, lambda _timeout_s: time.monotonic() - began_s > 0.1)
    assert ahead._state_of_server() is None
    assert time.monotonic() - began_s < ANSWER_TIMEOUT_S / 2


def test_the_same_scene_sent_again_is_not_built_again(tmp_path: Path) -> None:
    session = tmp_path / "session.json"
    document = scene(tmp_path)
    node, published, control = map(ports.endpoint, ports.private_ports(3))
    settings = ServerSettings(session=session, subscribe=(node,), publish=published, control=control)
    ahead, built = StandbyRenderer(settings, None, lambda _timeout_s: False), list[SceneDocument]()

    def build() -> None:
        built.append(settings.initial_scene())
        ahead._built = _Built(Mock(), built[-1], _stamp(_assets(built[-1])))

    for shown, count in ((document, 1), (document, 1), (document.replaced(revision=8), 2)):
        session.write_text(shown.model_dump_json())
        written_s = time.time() - 10 + count + len(built)
        os.utime(session, (written_s, written_s))
        with (
            patch.object(ahead, "_build", build),
            patch.object(ahead, "_state_of_server", return_value="running"),
        ):
            ahead._look()
        assert len(built) == count


@pytest.mark.parametrize("has_picture", [True, False])
def test_a_spare_that_is_called_after_a_picture_of_each_camera_keeps_its_renderer(has_picture: bool) -> None:
    node_port, published, control = map(ports.endpoint, ports.private_ports(3))
    settings = ServerSettings(subscribe=(node_port,), publish=published, control=control)
    renderer, pace = Mock(), Mock()
    renderer.submit_cameras.return_value = []
    ahead = StandbyRenderer(
        settings, None, lambda _timeout_s: renderer.submit_cameras.called or not has_picture
    )
    node = Node(node_port)
    try:
        with nullcontext() if has_picture else pytest.raises(CalledError):
            ahead._render(renderer, SceneDocument(), pace)
    finally:
        node.close()
    assert renderer.submit_cameras.call_count == has_picture


def test_a_killed_server_comes_back_with_what_its_spare_has_built(
    station_of: Callable[[str], Station],
) -> None:
    station = station_of(COMMAND_LINE)
    station.wait_for_spare_to_say("scene built ahead")
    station.kill()
    station.wait_for(lambda: station.picture().scene_revision == 7)
    assert station.shown() == station.document
    station.wait_for(lambda: any(USES_IT in line for line in station.lines))


def test_a_scene_that_was_built_ahead_and_changed_since_is_not_shown(
    station_of: Callable[[str], Station],
) -> None:
    station = station_of(COMMAND_LINE)
    station.wait_for_spare_to_say("scene built ahead")
    station.move_cup()
    station.kill()
    station.wait_for(lambda: station.picture().scene_revision == 8)
    assert station.shown().objects[0].pose.translation_m == (0.1, 0, 0.5)
    assert not any(USES_IT in line for line in station.lines)


def test_a_scene_that_changed_is_built_ahead_anew(station_of: Callable[[str], Station]) -> None:
    station = station_of(COMMAND_LINE)
    station.wait_for_spare_to_say("scene built ahead")
    station.move_cup()
    station.wait_for_spare_to_say("revision=8")
    station.kill()
    station.wait_for(lambda: station.picture().scene_revision == 8)
    assert station.shown().objects[0].pose.translation_m == (0.1, 0, 0.5)
    station.wait_for(lambda: any(USES_IT in line for line in station.lines))


def test_a_spare_that_can_build_nothing_ahead_takes_over_all_the_same(
    station_of: Callable[[str], Station],
) -> None:
    station = station_of(WITHOUT_MEMORY)
    station.wait_for_spare_to_say("nothing is built ahead")
    assert "too little memory for a second renderer" in station._heard
    station.kill()
    station.wait_for(lambda: station.picture().scene_revision == 7)
    assert station._heard.count("nothing is built ahead") == 1
    assert not any("built ahead" in line for line in station.lines)
