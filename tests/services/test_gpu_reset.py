"""A GPU that was reset: the process says so, counts it and ends; another goes on with the same scene."""

import time
from pathlib import Path

import pytest

from deltalight.protocol.envelope import decode
from deltalight.protocol.messages import CompositeMessage, StatsMessage
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.lost_context import GpuResetError, check_reset
from deltalight.render_server.server.session import RenderSession
from deltalight.render_server.server.session_host import SessionIdentity
from deltalight.services import ports
from deltalight.services.api.streams import ProcessWatch
from deltalight.services.child import ChildSpec
from deltalight.services.cli import run
from deltalight.services.supervisor import Supervisor
from tests.services.conftest import color, depth, pose
from tests.services.render_server_samples import InvertingRenderer
from tests.services.test_render_server_sockets import Node

GUILTY, INNOCENT, UNKNOWN = 0x8253, 0x8254, 0x8255
PATIENCE_S = 60.0
# A render server whose driver reports a reset, as this machine's cannot be brought to, after 400 questions (two a
# frame); its next process has none.
RESET_ONCE = """
import sys
from pathlib import Path
from deltalight.render_server.gpu import context
from deltalight.services.cli import run

def reset_status(ctx, load):
    mark = Path(sys.argv[1])
    if mark.exists():
        return lambda: 0
    mark.touch()
    answers = iter([0] * 400)
    return lambda: next(answers, 0x8254)

context.reset_status = reset_status
sys.exit(run(sys.argv[2:]))
"""


def stats(state: str, **drops: int) -> StatsMessage:
    return StatsMessage.model_validate({"node": "server", "capture_ns": 1, "state": state, "drops": drops})


def feed(session: RenderSession, number: int) -> None:
    for message in (color(number, number), depth(number, number), pose(number, number)):
        session.receive(message)


def session_of(renderer: InvertingRenderer) -> RenderSession:
    return RenderSession(renderer, SceneDocument(), identity=SessionIdentity(renderer_name="abacus"))


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (GUILTY, "by work of this process"),
        (INNOCENT, "by work of another process"),
        (UNKNOWN, "for a reason unknown to the driver"),
    ],
)
def test_each_kind_of_reset_is_a_sentence(status: int, words: str) -> None:
    check_reset(0)
    with pytest.raises(GpuResetError, match=f"^The GPU was reset {words}, and all .*: start it again\\.$"):
        check_reset(status)


def test_a_reset_ends_the_session_at_once_and_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = InvertingRenderer()
    session = session_of(renderer)
    monkeypatch.setattr(renderer, "submit_cameras", lambda *_, **__: check_reset(GUILTY))
    feed(session, 1)
    with pytest.raises(GpuResetError) as caught:
        session.step()
    last = session.stats(ends_by=caught.value)
    assert (last.state, last.drops["gpu_resets"]) == ("stopping", 1)
    assert last.detail == f"abacus; {caught.value}"


def test_a_fault_in_the_next_frame_does_not_lose_the_one_in_flight() -> None:
    renderer = InvertingRenderer()
    renderer.immediate, renderer.fails_at = False, {2}
    session, shown = session_of(renderer), []
    for number in range(1, 5):
        feed(session, number)
        rendered = session.step()
        shown.append(None if rendered is None else rendered.message.frame_id)
    assert shown == [None, None, 1, 3]
    assert session.counts["bad_frames"] == 1


def test_what_ended_processes_lost_is_added_to_what_the_next_lose() -> None:
    watch = ProcessWatch()
    for report in (
        stats("running", send=2),
        stats("stopping", send=3, gpu_resets=1),
        stats("running", send=0),
    ):
        watch.note(report)
    assert watch.reports()[0].lost == {"send": 3, "gpu_resets": 1}
    watch.note(stats("stopping", send=4, gpu_resets=1))
    watch.note(stats("waiting", send=1))
    watch.note(stats("running", send=2))
    assert watch.reports()[0].lost == {"send": 9, "gpu_resets": 2}
    watch.note(stats("running", send=0))  # killed, it could not say what it had lost
    assert watch.reports()[0].lost == {"send": 7, "gpu_resets": 2}


def test_the_command_line_ends_with_a_code_that_is_not_of_wrong_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "deltalight.render_server.server.process.run_server", lambda *_: check_reset(INNOCENT)
    )
    assert run(["server"]) == GpuResetError.exit_code == 75
    assert capsys.readouterr().err.startswith("deltalight: The GPU was reset by work of another process")


@pytest.mark.slow
def test_another_process_goes_on_with_the_same_scene(tmp_path: Path) -> None:
    node_port, published, control = ports.private_ports(3)
    session = tmp_path / "session.json"
    session.write_text(SceneDocument(revision=7).model_dump_json())
    options = ["--session", str(session), "--subscribe", ports.endpoint(node_port), "--allow-software"]
    sockets = ["--publish", ports.endpoint(published), "--control", ports.endpoint(control)]
    code = ("-c", RESET_ONCE, str(tmp_path / "reset"), "server", *options, *sockets)
    node, lines, watch = Node(ports.endpoint(node_port)), list[str](), ProcessWatch()
    receiver = Receiver([ports.endpoint(published)], ["composite", "stats"])
    newest, deadline_s = dict[str, CompositeMessage](), time.monotonic() + PATIENCE_S

    def shown_again() -> bool:
        assert time.monotonic() < deadline_s, lines
        for multipart in (receiver.latest(0) or {}).values():
            message, _ = decode(multipart)
            if isinstance(message, StatsMessage):
                watch.note(message)
            elif isinstance(message, CompositeMessage):
                newest["first" if supervisor.restarts()["render server"] == 0 else "again"] = message
        return "again" in newest and [each.message.state for each in watch.reports()] == ["running"]

    with Supervisor([ChildSpec("render server", code)], forward=lines.append) as supervisor:
        supervisor.run(until=shown_again)
    node.close()
    receiver.close()
    assert newest["first"].scene_revision == newest["again"].scene_revision == 7
    assert newest["again"].frame_id > newest["first"].frame_id
    assert watch.reports()[0].lost["gpu_resets"] == 1
    said = [line for line in lines if "was reset" in line or "died" in line]
    assert len(said) == 2
    assert said[0].startswith("render server: deltalight: The GPU was reset by work of another process")
    assert said[1] == "render server: died with exit code 75; restarting it."
