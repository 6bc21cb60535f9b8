"""Several nodes at one render session: which frames are rendered together, and what pictures say of them."""

from pathlib import Path
from typing import Any

import cv2
import pytest

from deltalight.protocol.codecs import encode_color
from deltalight.protocol.envelope import decode, encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import MAX_CAMERAS, CameraStatus, ColorMessage, ControlRequest, PoseMessage
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.server.session import RenderedFrame, RenderSession
from deltalight.render_server.server.session_host import SessionHost, SessionIdentity, SourceInUse
from tests.services.conftest import HEIGHT, IDENTITY, WIDTH, camera, picture, received
from tests.services.render_server_samples import InvertingRenderer

START = 10**15
MS = 10**6
BOARD: dict[str, Any] = {
    "type": "aruco_grid",
    "dictionary": "DICT_4X4_50",
    "marker_length_m": 0.04,
    "separation_m": 0.01,
    "rows": 2,
    "columns": 3,
    "first_id": 0,
}


class Room:
    """A session with a clock, and nodes that send to it."""

    def __init__(self, endpoints: int = 1) -> None:
        self.now_ns = START
        self.renderer = InvertingRenderer()
        scene = SceneDocument.model_validate({"real": {"geometry": {"model": "/nowhere/table.glb"}}})
        self.session = RenderSession(
            self.renderer,
            scene,
            identity=SessionIdentity("server"),
            clock_ns=lambda: self.now_ns,
            endpoints=endpoints,
            host=SessionHost(use_source=lambda _: SourceInUse((), is_another=True)),
        )

    def send(
        self,
        node: str,
        number: int,
        *,
        board: dict[str, Any] | None = None,
        behind_ms: float | None = None,
        has_camera: bool = True,
    ) -> None:
        """Sends a frame; `behind_ms`: how much older it is by clocks that were compared to 1 ms."""
        stamps: dict[str, Any] = {"node": node, "frame_id": number, "capture_ns": self.now_ns}
        if behind_ms is not None:
            stamps |= {"clock_offset_ns": -int(behind_ms * MS), "clock_bound_ns": MS}
        found = PoseMessage(**stamps, status="ok", world_from_camera=IDENTITY, board=board)
        described = camera().to_dict() if has_camera else {}
        seen = ColorMessage(**stamps, encoding="raw", shape=(HEIGHT, WIDTH, 3), camera=described)
        pixels = encode_color(picture(number), "raw")
        for multipart in (encode(found), encode(seen, [pixels])):
            self.session.receive(received(multipart, self.now_ns))

    def pass_ms(self, elapsed_ms: float) -> None:
        """Lets time pass."""
        self.now_ns += int(elapsed_ms * MS)

    def pictures(self) -> list[RenderedFrame]:
        """Takes all pictures that the session has now."""
        found = []
        while (rendered := self.session.step()) is not None:
            found.append(rendered)
        return found

    def shown(self) -> list[tuple[str, int]]:
        """Names and frames of all pictures that the session has now."""
        return [(each.message.node, each.message.frame_id) for each in self.pictures()]

    def begin(self, *nodes: str, **frame: Any) -> None:  # noqa: ANN401
        """Has each node send two frames, 100 ms apart, and takes their pictures."""
        for number in range(2):
            for node in nodes:
                self.send(node, number, **frame)
            self.pass_ms(50)
            self.pictures()
            self.pass_ms(50)

    def statuses(self) -> dict[str, CameraStatus]:
        """What receivers are told of the cameras, over the wire."""
        message = self.session.cameras()
        assert message is not None
        told, _ = decode([memoryview(piece) for piece in encode(message)])
        assert told == message
        return {each.node: each.status for each in message.cameras}

    def ask(self, op: str, **payload: Any) -> dict[str, object]:  # noqa: ANN401
        return self.session.execute(ControlRequest(node="test", id="r1", op=op, payload=payload))


@pytest.fixture
def room() -> Room:
    return Room()


def test_one_camera_s_pictures_name_the_server(room: Room) -> None:
    room.send("left", 1)
    assert room.shown() == [("server", 1)]
    assert room.statuses() == {"left": "live"}
    assert set(room.session.stats().rates) == {"frames_per_s"}


def test_frames_of_a_moment_are_rendered_together_and_each_picture_names_its_node(room: Room) -> None:
    room.begin("left", "right")
    room.send("right", 7)
    assert room.shown() == []  # that of the other is due
    room.pass_ms(3)
    room.send("left", 5)
    pictures = room.pictures()
    assert [(each.message.node, each.message.frame_id) for each in pictures] == [("left", 5), ("right", 7)]
    assert [int(each.pictures[0][0, 0, 0]) for each in pictures] == [250, 248]
    assert room.renderer.rooms[-1] == [("left", 5, True), ("right", 7, True)]
    assert set(room.session.stats().rates) == {"frames_per_s", "frames_per_s left", "frames_per_s right"}


def test_first_frames_and_those_after_a_pause_wait_for_all_endpoints() -> None:
    room, names = Room(endpoints=3), ("left", "right", "above")
    for pause in range(3):
        for name in names:
            assert room.shown() == []
            room.pass_ms(100)
            room.send(name, pause)
        assert room.shown() == [(name, pause) for name in names]
        assert set(room.statuses().values()) == {"live"}
        for _ in range(6):
            room.begin(*names)
        room.pass_ms(5000)
    room.send("left", 7)
    for elapsed_ms in (299, 1):
        assert room.shown() == []
        room.pass_ms(elapsed_ms)
    assert room.shown() == [("left", 7)]
    assert room.statuses() == {"left": "live", "right": "silent", "above": "silent"}
    assert room.renderer.rooms[-1] == [("left", 7, True), ("right", 1, False), ("above", 1, False)]
    room.pass_ms(100)
    room.send("left", 8)
    assert room.shown() == [("left", 8)], "they are not waited for again and again"


def test_a_slower_camera_is_not_waited_for_and_its_last_frame_lights_the_room(room: Room) -> None:
    for number in range(12):
        if number % 6 == 0:
            room.send("slow", number)
        room.send("fast", number)
        room.pass_ms(20)
        room.pictures()
        room.pass_ms(80)
    room.send("fast", 13)
    assert room.shown() == []  # the slow one is due
    room.pass_ms(10)
    assert room.shown() == [("fast", 13)]
    assert room.renderer.rooms[-1] == [("slow", 6, False), ("fast", 13, True)]
    room.send("slow", 14)
    room.send("fast", 14)
    assert room.shown() == [("slow", 14), ("fast", 14)]
    room.pass_ms(100)
    room.send("fast", 15)
    assert room.shown() == [("fast", 15)]  # at once: the slow one is not due


def test_a_silent_camera_drops_out_with_one_notice_and_has_its_place_again(
    room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    room.begin("left", "right")
    for number in range(30):  # three seconds
        room.send("right", number)
        at_once = room.shown()
        room.pass_ms(10)
        assert [*at_once, *room.shown()] == [("right", number)]
        room.pass_ms(90)
    assert at_once  # the other is not waited for any more
    assert room.renderer.rooms[-1] == [("right", 29, True), ("left", 1, False)]  # lights the room for a while
    assert room.statuses() == {"left": "silent", "right": "live"}
    assert "The camera left sends no frames; the others continue without it." in room.session.stats().detail
    assert capsys.readouterr().out.count("a camera is left out") <= 1
    for number in range(30, 60):
        room.send("right", number)
        room.pictures()
        room.pass_ms(1000)
    assert [cameras[0][1] for cameras in room.renderer.rooms if len(cameras) == 1] == [
        57,
        58,
        59,
    ]  # 30 s later
    room.send("left", 40)
    room.send("right", 40)
    assert room.shown() == [("left", 40), ("right", 40)]
    assert room.statuses() == {"left": "live", "right": "live"}
    assert "left" not in room.session.stats().detail


def test_cameras_keep_their_places_in_the_renderer_but_the_first_is_live(room: Room) -> None:
    room.begin("left", "right", "above")
    for number in range(30):
        for name in ("left", "above") if number < 15 else ("above", "right"):
            room.send(name, number)
        room.pass_ms(20)
        room.pictures()
        room.pass_ms(180)
        if number == 14:
            assert room.renderer.rooms[-1] == [("left", 14, True), ("right", 1, False), ("above", 14, True)]
    assert room.statuses() == {"left": "silent", "right": "live", "above": "live"}
    assert room.renderer.rooms[-1] == [("right", 29, True), ("left", 14, False), ("above", 29, True)]


def test_a_camera_whose_frames_come_late_lights_the_room_by_what_it_saw_in_time(room: Room) -> None:
    room.begin("left", "right", behind_ms=0)
    for number in range(5, 105):  # a link that stuttered hands over what it had queued
        room.send("left", number, behind_ms=0)
        room.send("right", number, behind_ms=4000)
        assert room.shown() == [("left", number)]
        is_remembered = number < 65
        room.pass_ms(500)
        assert len(room.renderer.rooms[-1]) == (2 if is_remembered else 1)
        if is_remembered:
            assert room.renderer.rooms[-1][1] == ("right", 1, False)
    assert room.statuses() == {"left": "live", "right": "other_time"}
    room.send("left", 200, behind_ms=0)
    room.send("right", 200, behind_ms=0)
    assert room.shown() == [("left", 200), ("right", 200)]


def test_the_first_camera_is_left_out_too_if_its_frames_come_late(room: Room) -> None:
    room.begin("left", "right", "above", behind_ms=0)
    for name, behind_ms in (("left", 4000), ("right", 0), ("above", 30)):
        room.send(name, 5, behind_ms=behind_ms)
    assert room.shown() == [("right", 5), ("above", 5)]
    assert room.statuses() == {"left": "other_time", "right": "live", "above": "live"}
    assert room.renderer.rooms[-1] == [("right", 5, True), ("left", 1, False), ("above", 5, True)]
    assert (
        "left out: its frames are from a different time than those of right." in room.session.stats().detail
    )


def test_a_clock_that_goes_ahead_excludes_its_own_camera_alone(room: Room) -> None:
    for name, behind_ms in (("left", 0), ("ahead", -3_600_000), ("right", 0)):
        room.send(name, 1, behind_ms=behind_ms)
    assert room.shown() == [("left", 1), ("right", 1)]
    assert room.statuses() == {"left": "live", "ahead": "other_time", "right": "live"}


def test_a_camera_that_takes_a_picture_every_three_seconds_is_not_silent(room: Room) -> None:
    for number in range(3):
        room.send("slow", number)
        for _ in range(30):
            room.send("fast", number)
            room.pass_ms(100)
            room.pictures()
    assert room.statuses() == {"slow": "live", "fast": "live"}


def test_a_camera_with_another_board_is_left_out_until_it_sees_the_same(room: Room) -> None:
    other = {**BOARD, "marker_length_m": 0.05}
    room.begin("left", board=BOARD)
    room.send("left", 5, board=BOARD)
    room.send("right", 5, board=other)
    assert room.shown() == [("left", 5)]
    assert room.statuses() == {"left": "live", "right": "other_board"}
    room.send("left", 6, board=BOARD)
    room.send("right", 6, board=BOARD)
    assert room.shown() == [("left", 6), ("right", 6)]


@pytest.mark.parametrize(
    ("behind_ms", "status"), [(1990, "live"), (2001, "live"), (2003, "other_time"), (3_600_000, "other_time")]
)
def test_frames_of_a_room_are_of_one_time_within_the_clocks_bounds(
    room: Room, behind_ms: float, status: CameraStatus
) -> None:
    room.send("left", 1, behind_ms=0)
    room.send("right", 1, behind_ms=behind_ms)
    shown = room.shown()
    assert room.statuses() == {"left": "live", "right": status}
    assert shown == [("left", 1), ("right", 1)][: 2 if status == "live" else 1]


def test_clocks_that_were_never_compared_count_by_arrival(room: Room) -> None:
    room.send("left", 1, behind_ms=0)
    room.send("replayed", 1)
    room.pictures()
    assert set(room.statuses().values()) == {"live"}


def test_a_broken_camera_does_not_hold_up_the_others(room: Room) -> None:
    room.begin("left", "right")
    room.send("left", 5, has_camera=False)
    room.send("right", 5)
    assert room.shown() == []
    room.pass_ms(10)
    assert room.shown() == [("right", 5)]
    assert room.session.counts["bad_frames"] == 1


def test_nodes_beyond_the_limits_are_counted(room: Room) -> None:
    for number in range(3 * MAX_CAMERAS):
        room.send(f"node-{number}", number)
    assert len(room.pictures()) == MAX_CAMERAS
    assert len(room.statuses()) == MAX_CAMERAS
    assert (
        room.session.drops()["unplaced"] == MAX_CAMERAS + 2 * MAX_CAMERAS
    )  # frames, and two messages a node


def test_a_new_camera_takes_the_place_of_the_one_that_is_silent_longest_where_all_are_taken(
    room: Room,
) -> None:
    names = [f"node-{number}" for number in range(MAX_CAMERAS)]
    room.begin(*names)
    for number in range(30):
        for name in names[2:] if number > 10 else names[1:]:
            room.send(name, number)
        room.pass_ms(20)
        room.pictures()
        room.pass_ms(80)
    for number, name in enumerate(("new", *names[1:])):
        room.send(name, 100 + number)
    assert len(room.pictures()) == MAX_CAMERAS
    assert list(room.statuses()) == [*names[1:], "new"]
    assert "unplaced" not in room.session.drops()


def test_changes_of_the_cameras_are_told_once(room: Room) -> None:
    session = room.session
    assert session.cameras() is None
    room.begin("left")
    assert session.cameras(if_changed=True) is not None
    room.begin("left")
    assert session.cameras(if_changed=True) is None
    room.begin("left", "right")
    assert session.cameras(if_changed=True) is not None
    room.ask("set_source", endpoints=None)
    emptied = session.cameras(if_changed=True)
    assert emptied is not None
    assert emptied.cameras == ()
    assert session.cameras() is None


def test_pick_and_snapshot_are_of_the_camera_that_is_asked_for(room: Room, tmp_path: Path) -> None:
    room.begin("left", "right")
    room.send("left", 5)
    room.send("right", 7)
    room.pictures()
    assert room.ask("pick", x=1, y=1)["frame_id"] == 5
    assert room.ask("pick", x=1, y=1, camera="right")["frame_id"] == 7
    order: dict[str, Any] = {"folder": str(tmp_path), "pictures": [{"name": "a"}]}
    assert room.ask("snapshot", **order)["frame_id"] == 5
    assert room.ask("snapshot", **order, camera="right")["frame_id"] == 7
    assert room.renderer.rooms[-1] == [("left", 5, False), ("right", 7, True)]
    written = cv2.imread(str(tmp_path / "a.png"))
    assert written is not None
    assert written[0, 0].tolist() == [248] * 3
    for op, payload in (("pick", {"x": 1, "y": 1}), ("snapshot", order)):
        with pytest.raises(DeltalightError, match=r"No frame|Nothing"):
            room.ask(op, **payload, camera="nobody")


def test_on_a_gpu_a_room_s_pictures_are_read_back_after_the_next_were_started(room: Room) -> None:
    room.begin("left", "right")
    room.renderer.immediate = False
    for number in (5, 6):
        room.send("left", number)
        room.send("right", number)
        first = room.session.step()
        assert (first is None) == (number == 5)
    assert room.shown() == [("right", 5), ("left", 6), ("right", 6)]
    assert not room.session.is_waiting
