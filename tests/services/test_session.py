"""A render session with a renderer that the test gives: frames, faults, commands."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from protocol.errors import DeltalightError
from protocol.frames import ViewFrame
from protocol.messages import ControlRequest
from protocol.scene import SceneDocument
from render_server.frame_assembly import FrameAssembler
from render_server.session import MAXIMUM_FAULTS_IN_A_ROW, RenderSession
from tests.services.conftest import color, depth, pose, received

START = 10**15


@dataclass
class Picture:
    color: np.ndarray
    status: Literal["ok", "no_pose"]
    pass_times_ms: dict[str, float] = field(default_factory=lambda: {"linearize": 1.5})
    lights: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class Started:
    finish: Callable[[], Picture]
    immediate: bool


class InvertingRenderer:
    """Inverts the picture; fails where the test says so."""

    def __init__(self) -> None:
        self.fails_at: set[int] = set()
        self.immediate = True
        self.notices: list[str] = []
        self.scenes: list[SceneDocument] = []

    def start(self, frame: ViewFrame) -> Started:
        if frame.frame_id in self.fails_at:
            raise RuntimeError("the volume fell over")
        picture = Picture(255 - frame.color, "no_pose" if frame.pose is None else "ok")
        return Started(lambda: picture, self.immediate)

    def set_scene(self, scene: SceneDocument) -> None:
        if scene.name == "refused":
            raise DeltalightError("This scene cannot be shown; take another.")
        self.scenes.append(scene)


def request(op: str, revision: int | None = None, **payload: object) -> ControlRequest:
    return ControlRequest(node="test", id="r1", op=op, revision=revision, payload=payload)


@pytest.fixture
def renderer() -> InvertingRenderer:
    return InvertingRenderer()


@pytest.fixture
def kept() -> list[SceneDocument]:
    return []


@pytest.fixture
def session(renderer: InvertingRenderer, kept: list[SceneDocument]) -> RenderSession:
    return RenderSession(
        renderer,
        SceneDocument(name="first", revision=3),
        assembler=FrameAssembler(),
        renderer_name="abacus",
        keep_scene=kept.append,
        mailbox_drops=lambda: {"color.cam": 4},
        clock_ns=lambda: START,
    )


def feed(session: RenderSession, number: int) -> None:
    for message in (
        color(number, START + number, START),
        depth(number, START + number),
        pose(number, START + number),
    ):
        session.receive(message)


def test_composite_carries_its_own_frames_header(session: RenderSession) -> None:
    feed(session, 5)
    rendered = session.step()
    assert rendered is not None
    assert (rendered.message.frame_id, rendered.message.capture_ns) == (5, START + 5)
    assert rendered.message.status == "ok"
    assert rendered.message.pass_times_ms == {"linearize": 1.5}
    assert rendered.message.drops["color.cam"] == 4
    assert np.all(rendered.pixels == 250)
    assert session.step() is None


def test_bad_frame_is_counted_and_the_next_is_rendered(
    session: RenderSession, renderer: InvertingRenderer
) -> None:
    renderer.fails_at = {1}
    feed(session, 1)
    assert session.step() is None
    assert session.counts["bad_frames"] == 1
    assert session.stats().state == "degraded"
    feed(session, 2)
    assert session.step() is not None
    assert session.stats().state == "running"


def test_renderer_that_only_fails_ends_the_process_after_a_while(
    session: RenderSession, renderer: InvertingRenderer
) -> None:
    renderer.fails_at = set(range(100))
    for number in range(MAXIMUM_FAULTS_IN_A_ROW - 1):
        feed(session, number)
        assert session.step() is None
    feed(session, MAXIMUM_FAULTS_IN_A_ROW)
    with pytest.raises(RuntimeError, match="fell over"):
        session.step()


def test_bad_message_is_counted(session: RenderSession) -> None:
    session.receive(received([b"color.cam", b"\xc1garbage", b""], START))
    assert session.counts["bad_messages"] == 1
    assert session.drops()["bad_messages"] == 1


def test_set_scene_is_idempotent_by_revision(
    session: RenderSession, renderer: InvertingRenderer, kept: list[SceneDocument]
) -> None:
    document = SceneDocument(name="second").model_dump(mode="json")
    for _ in range(2):
        assert session.carry_out(request("set_scene", 4, scene=document)) == {"revision": 4}
    assert [scene.name for scene in renderer.scenes] == ["second"]
    assert [scene.revision for scene in kept] == [4]
    with pytest.raises(DeltalightError, match="already at revision 4"):
        session.carry_out(request("set_scene", 3, scene=document))
    with pytest.raises(DeltalightError, match="already at revision 4"):
        session.carry_out(request("set_scene", 4, scene={**document, "name": "third"}))


def test_wrong_or_refused_scene_changes_nothing(session: RenderSession, kept: list[SceneDocument]) -> None:
    with pytest.raises(DeltalightError, match="nearest known key is `lights`"):
        session.carry_out(request("set_scene", 4, scene={"light": {}}))
    with pytest.raises(DeltalightError, match="cannot be shown"):
        session.carry_out(request("set_scene", 4, scene={"name": "refused"}))
    assert session.scene.name == "first"
    assert kept == []


def test_set_view_and_get_scene(session: RenderSession) -> None:
    assert session.carry_out(request("set_view", view="delta")) == {"revision": 4}
    scene = session.carry_out(request("get_scene"))["scene"]
    assert isinstance(scene, dict)
    assert scene["output"]["view"] == "delta"
    with pytest.raises(DeltalightError, match="view"):
        session.carry_out(request("set_view", view="upside-down"))


def test_other_commands(session: RenderSession) -> None:
    assert session.carry_out(request("ping")) == {}
    stats = session.carry_out(request("stats"))["stats"]
    assert isinstance(stats, dict)
    assert stats["detail"] == "abacus"
    with pytest.raises(DeltalightError, match="did you mean shutdown"):
        session.carry_out(request("shutdwn"))
    session.carry_out(request("shutdown"))
    assert session.stopping


def test_scene_with_a_model_needs_no_depth(tmp_path: Path) -> None:
    scene = SceneDocument.model_validate({"real": {"geometry": {"model": str(tmp_path / "table.glb")}}})
    session = RenderSession(InvertingRenderer(), scene, clock_ns=lambda: START)
    session.receive(color(1, START, START))
    session.receive(pose(1, START))
    assert session.step() is not None


def test_on_a_gpu_a_frame_is_read_back_after_the_next_was_started(
    session: RenderSession, renderer: InvertingRenderer
) -> None:
    renderer.immediate = False
    for number in (0, 1):
        feed(session, number)
        rendered = session.step()
        assert (None if rendered is None else rendered.message.frame_id) == (None, 0)[number]
    assert session.is_waiting_for_gpu
    last = session.step()
    assert last is not None
    assert last.message.frame_id == 1
    assert not session.is_waiting_for_gpu
