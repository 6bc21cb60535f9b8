"""A render session with a renderer that the test gives: frames, faults, commands."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import MAX_LABELS, MAX_SENTENCE
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.render_server.server import frames
from deltalight.render_server.server.session import (
    MAXIMUM_FAULTS_IN_A_ROW,
    WATCHED_NS,
    RenderSession,
)
from deltalight.render_server.server.session_host import SessionHost, SessionIdentity, SourceInUse
from tests.services.conftest import IDENTITY, camera, color, depth, pose, received
from tests.services.render_server_samples import InvertingRenderer

START = 10**15


def request(
    op: str, revision: int | None = None, scene_id: str | None = None, **payload: object
) -> ControlRequest:
    return ControlRequest(node="test", id="r1", op=op, scene_id=scene_id, revision=revision, payload=payload)


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
        identity=SessionIdentity(renderer_name="abacus"),
        host=SessionHost(keep_scene=kept.append, mailbox_drops=lambda: {"color.cam": 4}),
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
    assert rendered.message.reused_pass_times_ms == {"voxelize": 4.0}
    assert (rendered.message.quality, rendered.message.scale) == ("live", 0.5)
    assert rendered.message.drops["color.cam"] == 4
    assert np.all(rendered.pictures[0] == 250)
    assert session.step() is None


def test_composite_says_with_which_camera_pose_and_scene_it_was_made(session: RenderSession) -> None:
    feed(session, 5)
    rendered = session.step()
    assert rendered is not None
    assert (rendered.message.scene_id, rendered.message.scene_revision) == (None, 3)
    assert rendered.message.camera == camera().to_dict()
    assert rendered.message.world_from_camera == IDENTITY
    session.receive(color(6, START + 6, START))
    session.receive(depth(6, START + 6))
    session.receive(pose(6, START + 6, "no_board"))
    without = session.step()
    assert without is not None
    assert (without.message.status, without.message.world_from_camera) == ("no_pose", None)


def test_the_revision_is_that_of_the_frames_start(
    session: RenderSession, renderer: InvertingRenderer
) -> None:
    renderer.immediate = False
    revisions = []
    for number in range(3):
        feed(session, number)
        rendered = session.step()
        if rendered is not None:
            revisions.append((rendered.message.frame_id, rendered.message.scene_revision))
        if number == 1:  # frame 1 waits for the GPU
            assert session.execute(request("set_view", view="delta")) == {"revision": 4}
    last = session.step()
    assert last is not None
    revisions.append((last.message.frame_id, last.message.scene_revision))
    assert revisions == [(0, 3), (1, 3), (2, 4)]


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


def test_the_first_picture_is_told_in_shaders_until_there_is_one(session: RenderSession) -> None:
    first, many = session.preparation(12), session.preparation(99)
    assert first is not None
    assert many is not None
    assert (first.state, "12 of about 60" in first.detail) == ("starting", True)
    assert "99 of about 99" in many.detail
    feed(session, 1)
    assert session.step() is not None
    assert session.preparation(12) is None


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


def test_what_nodes_send_is_cut_to_the_limits_of_statistics_and_composites(
    renderer: InvertingRenderer,
) -> None:
    topics = {f"color.{number:03}{'x' * 110}": 2 for number in range(200)}
    session = RenderSession(
        renderer,
        SceneDocument(),
        identity=SessionIdentity(renderer_name="abacus" * 400),
        host=SessionHost(mailbox_drops=lambda: topics),
        clock_ns=lambda: START,
    )
    wrong = color(1, START, START, {**camera().to_dict(), "distortion_model": "w" * 5000})
    for message in (wrong, depth(1, START), pose(1, START)):
        session.receive(message)
    assert session.step() is None
    stats = session.stats()
    assert stats.detail.startswith("abacus")
    assert len(stats.detail) == MAX_SENTENCE
    assert stats.drops["bad_frames"] == 1
    assert sum(stats.drops.values()) == 401
    feed(session, 2)
    rendered = session.step()
    assert rendered is not None
    assert len(rendered.message.drops) == MAX_LABELS


@pytest.mark.parametrize(("stream", "other"), [(color, depth), (depth, color)])
def test_a_camera_of_another_size_than_its_picture_is_refused(
    session: RenderSession,
    stream: Callable[..., ReceivedMultipart],
    other: Callable[..., ReceivedMultipart],
) -> None:
    vast = {**camera().to_dict(), "width": 16384, "height": 16384}
    for message in (stream(1, START, described=vast), other(1, START), pose(1, START)):
        session.receive(message)
    assert session.step() is None
    assert "16384x16384" in session.stats().detail


def test_data_of_a_node_never_ends_the_renderer(
    session: RenderSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_arguments: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(frames, "decode_color", fail)
    for number in range(MAXIMUM_FAULTS_IN_A_ROW + 1):
        feed(session, number)
        assert session.step() is None


def test_set_scene_is_idempotent_by_revision(
    session: RenderSession, renderer: InvertingRenderer, kept: list[SceneDocument]
) -> None:
    document = SceneDocument(name="second").model_dump(mode="json")
    for _ in range(2):
        assert session.execute(request("set_scene", 4, scene=document)) == {"revision": 4}
    assert [scene.name for scene in renderer.scenes] == ["second"]
    assert [scene.revision for scene in kept] == [4]
    with pytest.raises(DeltalightError, match="already at revision 4"):
        session.execute(request("set_scene", 3, scene=document))
    with pytest.raises(DeltalightError, match="already at revision 4"):
        session.execute(request("set_scene", 4, scene={**document, "name": "third"}))


def test_revisions_of_one_scene_say_nothing_of_another(session: RenderSession) -> None:
    document = SceneDocument(name="second", revision=9).model_dump(mode="json")
    shown: list[object] = []

    def show(scene_id: str | None, revision: int | None) -> None:
        session.execute(request("set_scene", revision, scene_id, scene=document))
        feed(session, len(shown))
        rendered = session.step()
        assert rendered is not None
        shown.append((rendered.message.scene_id, rendered.message.scene_revision))

    sent = [("a", 7), ("a", 7), ("a", 8), ("b", 1), ("a", 7), (None, 1)]
    for scene_id, revision in sent:
        show(scene_id, revision)
    assert shown == sent
    show("a", 7)
    for wrong in (request("set_scene", 6, "a", scene=document), request("set_scene", 7, "a", scene={})):
        with pytest.raises(DeltalightError, match="already at revision 7"):
            session.execute(wrong)
    show("a", None)  # whatever came before, by the document's own revision
    show(None, None)  # counts on
    session.execute(request("set_view", view="delta"))
    assert shown[-3:] == [("a", 7), ("a", 9), (None, 10)]
    assert (session.scene_id, session.scene.revision) == (None, 11)


def test_a_changed_view_is_not_the_scene_of_its_sender(session: RenderSession) -> None:
    document = SceneDocument(name="second").model_dump(mode="json")
    session.execute(request("set_scene", 7, "a", scene=document))
    session.execute(request("set_view", view="delta"))
    assert (session.scene_id, session.scene.revision) == (None, 8)
    session.execute(request("set_scene", 8, "a", scene=document))
    assert (session.scene_id, session.scene.output.view) == ("a", "composite")


def test_wrong_or_refused_scene_changes_nothing(session: RenderSession, kept: list[SceneDocument]) -> None:
    with pytest.raises(DeltalightError, match="nearest known key is `lights`"):
        session.execute(request("set_scene", 4, scene={"light": {}}))
    with pytest.raises(DeltalightError, match="cannot be shown"):
        session.execute(request("set_scene", 4, scene={"name": "refused"}))
    assert session.scene.name == "first"
    assert kept == []


def test_watched_views_come_with_each_composite_as_long_as_they_are_watched(
    session: RenderSession, renderer: InvertingRenderer
) -> None:
    def shown(frame_id: int) -> list[str]:
        feed(session, frame_id)
        rendered = session.step()
        assert rendered is not None
        assert len(rendered.pictures) == len(rendered.message.part_rules())
        np.testing.assert_array_equal(rendered.pictures[0], 255 - renderer.newest["cam"].color)
        return [rendered.message.view, *(other.view for other in rendered.message.others)]

    assert shown(1) == ["composite"]
    assert session.execute(request("watch", views=["delta", "composite", "delta"])) == {
        "views": ["delta", "composite"]
    }
    assert shown(2) == ["composite", "delta"], "once each, the scene's own without an order"
    session.execute(request("set_view", view="delta"))
    assert shown(3) == ["delta", "composite"]
    session.execute(request("watch", views=[]))
    assert shown(4) == ["delta"]
    with pytest.raises(DeltalightError, match="the command watch"):
        session.execute(request("watch", views=["sideways"]))


def test_views_of_several_senders_are_watched_until_each_is_silent_for_a_minute() -> None:
    now_ns = START
    session = RenderSession(InvertingRenderer(), SceneDocument(), clock_ns=lambda: now_ns)
    first, second = (request("watch", views=[view, "rsm"]) for view in ("delta", "volume"))
    session.execute(first)
    now_ns += WATCHED_NS
    session.execute(second.model_copy(update={"node": "another"}))
    assert list(session.watched) == ["delta", "rsm", "volume"]
    now_ns += 1
    assert list(session.watched) == ["volume", "rsm"]
    session.execute(second.model_copy(update={"node": "another", "payload": {"views": []}}))
    assert list(session.watched) == []


def test_set_view_and_get_scene(session: RenderSession) -> None:
    assert session.execute(request("set_view", view="delta")) == {"revision": 4}
    scene = session.execute(request("get_scene"))["scene"]
    assert isinstance(scene, dict)
    assert scene["output"]["view"] == "delta"
    with pytest.raises(DeltalightError, match="view"):
        session.execute(request("set_view", view="upside-down"))


def test_other_commands(session: RenderSession) -> None:
    assert session.execute(request("ping")) == {
        "scene_id": None,
        "revision": 3,
        "instance": session.instance,
    }
    answer = session.execute(request("stats"))
    assert isinstance(stats := answer["stats"], dict)
    assert stats["detail"] == "abacus"
    assert answer["is_software"] is False
    with pytest.raises(DeltalightError, match="did you mean shutdown"):
        session.execute(request("shutdwn"))
    session.execute(request("shutdown"))
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
    assert session.is_waiting
    last = session.step()
    assert last is not None
    assert last.message.frame_id == 1
    assert not session.is_waiting


def test_programs_are_compiled_ahead_when_no_picture_waits_to_be_finished(
    session: RenderSession, renderer: InvertingRenderer
) -> None:
    renderer.immediate = False
    feed(session, 0)
    for expected in (0, 1):  # the picture is started, and finished
        session.step()
        session.compile_ahead()
        assert renderer.compiled_ahead == expected


def test_pick_asks_the_renderer(session: RenderSession, renderer: InvertingRenderer) -> None:
    with pytest.raises(DeltalightError, match="Nothing has been rendered yet"):
        session.execute(request("pick", x=3, y=4))
    feed(session, 5)
    session.step()
    picked = session.execute(request("pick", x=3, y=4.5))
    assert picked == {"frame_id": 5, "kind": "nothing", "pixel": [3.0, 4.5]}
    assert renderer.ignored is None
    session.execute(request("pick", x=3, y=4.5, ignore="knot"))
    assert renderer.ignored == "knot"
    for wrong in ({"x": 3}, {"x": 3, "y": "4"}, {"x": True, "y": 1}, {"x": 1, "y": 2, "z": 3}):
        with pytest.raises(DeltalightError, match="the command pick"):
            session.execute(request("pick", **wrong))


def test_a_snapshot_loses_no_frame_and_no_scene(
    session: RenderSession, renderer: InvertingRenderer, tmp_path: Path
) -> None:
    renderer.immediate = False
    order: dict[str, Any] = {
        "folder": str(tmp_path),
        "pictures": [{"name": "a", "view": "delta"}],
        "exr": True,
    }
    with pytest.raises(DeltalightError, match="No frame has come yet"):
        session.execute(request("snapshot", **order))
    feed(session, 7)
    assert session.step() is None  # it waits for the GPU
    taken = session.execute(request("snapshot", **order))
    assert taken == {
        "frame_id": 7,
        "capture_ns": START + 7,
        "files": ["a.png", "composite.exr"],
        "errors": {},
    }
    assert [scene.output.view for scene in renderer.scenes] == ["delta", "composite", "composite"]
    assert renderer.scenes[-1] == session.scene
    assert session.scene.revision == 3
    feed(session, 8)
    numbers = []
    for _ in range(3):
        rendered = session.step()
        numbers.append(None if rendered is None else rendered.message.frame_id)
    assert numbers == [7, None, 8]
    assert renderer.unfinished == []


def test_a_refused_snapshot_is_one_sentence(session: RenderSession, tmp_path: Path) -> None:
    feed(session, 7)
    session.step()
    for wrong, words in (
        ({"folder": str(tmp_path / "missing"), "exr": True}, "There is no folder"),
        ({"pictures": []}, "`folder` is missing"),
        ({"folder": str(tmp_path), "pictures": [{"name": "../a"}]}, "name"),
    ):
        with pytest.raises(DeltalightError, match=words):
            session.execute(request("snapshot", **wrong))


def test_another_source_begins_with_nothing_of_the_one_before(renderer: InvertingRenderer) -> None:
    used: list[object] = []

    def use_source(endpoints: object) -> SourceInUse:
        if endpoints == ("bad",):
            raise DeltalightError("bad is not an endpoint")
        is_another = endpoints not in used[-1:]
        used.append(endpoints)
        return SourceInUse(("tcp://configured",), is_another)

    renderer.immediate = False
    session = RenderSession(
        renderer, SceneDocument(), host=SessionHost(use_source=use_source), clock_ns=lambda: START
    )
    feed(session, 1)
    session.step()  # waits for the GPU
    session.receive(color(2, START + 2, START))  # waits for its pose and depth
    with pytest.raises(DeltalightError, match="bad is not an endpoint"):
        session.execute(request("set_source", endpoints=["bad"]))
    assert renderer.sources_begun == 0
    counted = dict(session.drops())
    answer = session.execute(request("set_source", endpoints=None))
    assert (answer, used, renderer.sources_begun) == ({"endpoints": ["tcp://configured"]}, [None], 1)
    assert session.drops() == counted
    session.receive(depth(2, START + 2))
    session.receive(pose(2, START + 2))
    assert session.step() is None
    assert renderer.unfinished == []
    with pytest.raises(DeltalightError, match="Nothing has been rendered"):
        session.execute(request("pick", x=1, y=1))
    wrong_sources: tuple[dict[str, object], ...] = (
        {},
        {"endpoints": []},
        {"endpoints": "tcp://127.0.0.1:1"},
        {"endpoints": ["a"] * 17},
    )
    for wrong in wrong_sources:
        with pytest.raises(DeltalightError, match="the command set_source"):
            session.execute(request("set_source", None, None, **wrong))
    for _ in range(2):  # the same again changes nothing
        assert session.execute(request("set_source", endpoints=["x"]))
    assert used == [None, ("x",), ("x",)]
    assert renderer.sources_begun == 2


def test_what_the_gpu_holds_is_counted_when_asked(renderer: InvertingRenderer) -> None:
    session = RenderSession(
        renderer, SceneDocument(), host=SessionHost(count_objects=lambda: {"Texture": 3, "Buffer": 5})
    )
    assert session.execute(request("gl_objects")) == {"Texture": 3, "Buffer": 5}
