"""The cameras of a room: streams are paired for each node, and the cameras' newest frames are rendered together.

A node is a camera once it has sent a complete frame. It keeps its place among the others while it is left out: it is
silent, sees another board than the first one, or its frames are of another time. What one that is silent or late saw
last lights the room for half a minute: without it the renderer would build everything for fewer cameras, which takes
seconds in software, and soon for all again.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import structlog

from deltalight.protocol.messages import MAX_CAMERAS, CameraEntry, CameraStatus, Message
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.server.frames import AssembledFrame, FrameAssembler, PairingSettings

SILENT_NS = 2 * 10**9  # without a frame; or this many of the camera's periods, if they are longer
SILENT_PERIODS = 5
REMEMBERED_NS = 30 * 10**9  # how long the last frame that counted lights the room
GATHER_NS = 300 * 10**6  # how long the first frames, and those after a pause, wait for all cameras
KEPT_ARRIVALS = 5
MAX_NODES = 2 * MAX_CAMERAS  # those that send light without frames included

log = structlog.get_logger()


class Taken(NamedTuple):
    """A camera's newest frame; `is_new`: it was not rendered yet."""

    camera: str
    frame: AssembledFrame
    is_new: bool

    def shown(self, *, is_shown: bool) -> CameraFrame:
        """Returns it for the renderer, with or without a picture of it."""
        return CameraFrame(self.camera, self.frame.view, is_shown=is_shown)


@dataclass(eq=False)
class _Place:
    """A camera and its newest frame, which is `new` since `ready_ns` or has been rendered.

    `counted`: the newest one while the camera was live.
    """

    name: str
    newest: AssembledFrame
    ready_ns: int
    is_new: bool = True
    counted: AssembledFrame | None = None
    status: CameraStatus = "live"
    remark: str = ""
    arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=KEPT_ARRIVALS))

    def note(self, frame: AssembledFrame, now_ns: int) -> None:
        """Takes a newer frame."""
        self.ready_ns = self.ready_ns if self.is_new else now_ns
        self.newest, self.is_new = frame, True
        self.arrivals_ns.append(frame.received_ns)

    @property
    def period_ns(self) -> int:
        """Mean time between its frames; 0 before the second."""
        count = len(self.arrivals_ns) - 1
        return (self.arrivals_ns[-1] - self.arrivals_ns[0]) // count if count > 0 else 0

    @property
    def patience_ns(self) -> int:
        """How long its newest frame counts."""
        return max(SILENT_NS, SILENT_PERIODS * self.period_ns)

    def entry(self) -> CameraEntry:
        """Returns its entry in the message for receivers of pictures."""
        header = self.newest.color
        return CameraEntry(
            node=self.name,
            status=self.status,
            frame_id=header.frame_id,
            capture_ns=header.capture_ns,
            received_ns=self.newest.received_ns,
        )


class RoomCameras:
    """Takes the messages of all nodes, and returns the frames to be rendered together.

    `on_fault` is called with the fault of a frame whose data is broken, which is dropped. `counts` are those of
    `FrameAssembler`, and `unplaced`: messages of nodes beyond `MAX_NODES` and frames of cameras beyond `MAX_CAMERAS`,
    while none of those that have a place is silent. `endpoints`: how many are read, so how many nodes to expect.
    """

    def __init__(
        self,
        settings: PairingSettings | None,
        on_fault: Callable[[Exception], None],
        *,
        needs_depth: bool,
        endpoints: int = 1,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.is_waiting = False  # for a camera's frame, to render others with it
        self._settings = settings or PairingSettings()
        self._on_fault = on_fault
        self._needs_depth = needs_depth
        self._endpoints = endpoints
        self._taken_ns = 0  # when frames were last returned
        self._gathers = True  # waits for all nodes, for the first time or after a pause
        self._assemblers: dict[str, FrameAssembler] = {}
        self._places: dict[str, _Place] = {}

    def need_depth(self, needs_depth: bool) -> None:
        """Says whether frames are complete only with depth."""
        self._needs_depth = needs_depth
        for assembler in self._assemblers.values():
            assembler.needs_depth = needs_depth

    def restart(self, endpoints: int) -> None:
        """Forgets all nodes, for another source of so many endpoints; counts continue."""
        self._assemblers, self._places, self.is_waiting = {}, {}, False
        self._endpoints, self._gathers = endpoints, True

    def add(self, message: Message, parts: Sequence[memoryview], multipart: ReceivedMultipart) -> None:
        """Stores a message until its partners arrive."""
        assembler = self._assemblers.get(message.node)
        if assembler is None:
            if len(self._assemblers) >= MAX_NODES and not self._make_room():
                self.counts["unplaced"] += 1
                return
            assembler = self._assemblers[message.node] = FrameAssembler(
                self._settings, needs_depth=self._needs_depth, counts=self.counts
            )
        assembler.add(message, parts, multipart.received_ns)

    @property
    def are_several(self) -> bool:
        """Whether more than one camera has a place."""
        return len(self._places) > 1

    @property
    def statuses(self) -> dict[str, CameraStatus]:
        """The status of each camera, in the order of their first frames."""
        return {place.name: place.status for place in self._places.values()}

    @property
    def entries(self) -> tuple[CameraEntry, ...]:
        """Returns all cameras, those left out included, in the order of their first frames."""
        return tuple(place.entry() for place in self._places.values())

    @property
    def remarks(self) -> tuple[str, ...]:
        """Why cameras are left out, a sentence for each."""
        return tuple(place.remark for place in self._places.values() if place.remark)

    def take(self, now_ns: int) -> tuple[Taken, ...]:
        """Returns the newest frame of each camera that counts, if any of them is new, else none.

        They are in the order of their first frames, but the first one is live. A new frame waits for those of other
        cameras that are due, for `together_ms` at most; after a pause of all of them, for those of all nodes: the GPU
        holds what so many cameras need.
        """
        self._gathers |= self._are_paused(now_ns)
        for name, assembler in list(self._assemblers.items()):
            try:
                frame = assembler.take(now_ns)
            except Exception as fault:  # a node's data is no reason to end, nor to hold up the others
                self._on_fault(fault)
                continue
            if frame is not None:
                self._note(name, frame, now_ns)
        self.is_waiting = self._gathers and self._must_gather(now_ns)
        if self.is_waiting:
            return ()
        members = self._members()
        self.is_waiting = self._must_wait(members, now_ns)
        if self.is_waiting or not any(place.is_new for place in members):
            return ()
        self._taken_ns, self._gathers = now_ns, False
        taken = self._room(members)
        for place in self._places.values():
            place.is_new = False
        return taken

    def _note(self, name: str, frame: AssembledFrame, now_ns: int) -> None:
        place = self._places.get(name)
        if place is None:
            if len(self._places) >= MAX_CAMERAS and not self._make_room():
                self.counts["unplaced"] += 1
                return
            place = self._places[name] = _Place(name, frame, now_ns)
        place.note(frame, now_ns)

    def _make_room(self) -> bool:
        """Forgets the camera that has been silent longest; returns whether there was one."""
        silent = [place for place in self._places.values() if place.status == "silent"]
        if not silent:
            return False
        longest = min(silent, key=lambda place: place.newest.received_ns).name
        del self._places[longest], self._assemblers[longest]
        return True

    def _are_paused(self, now_ns: int) -> bool:
        """Returns whether no camera has sent anything for as long as its frames count."""
        patience_ns = max((place.patience_ns for place in self._places.values()), default=0)
        return now_ns - self._taken_ns > patience_ns

    def _must_gather(self, now_ns: int) -> bool:
        """Returns whether the first frames after a pause still wait for those of nodes that are expected."""
        new_ns = [place.ready_ns for place in self._places.values() if place.is_new]
        expected = min(max(self._endpoints, len(self._assemblers)), MAX_CAMERAS)
        return 0 < len(new_ns) < expected and now_ns - min(new_ns) < GATHER_NS

    def _must_wait(self, members: Sequence[_Place], now_ns: int) -> bool:
        new_since_ns = min((place.ready_ns for place in members if place.is_new), default=None)
        together_ns = int(1e6 * self._settings.together_ms)
        if new_since_ns is None or now_ns - new_since_ns >= together_ns:
            return False
        return any(
            not place.is_new and now_ns - place.newest.received_ns >= place.period_ns - together_ns
            for place in members
        )

    def _members(self) -> list[_Place]:
        """Returns the cameras whose frames count, and notes why the others' do not."""
        places = list(self._places.values())
        if not places:
            return []
        newest_ns = max(place.newest.received_ns for place in places)
        live = [place for place in places if newest_ns - place.newest.received_ns <= place.patience_ns]
        newest = max(live, key=_captured_ns)
        first = next(place for place in live if _is_of_the_time_of(place, newest))
        for place in places:
            self._judge(place, first, newest, is_silent=place not in live)
        return [place for place in live if place.status == "live"]

    def _room(self, members: Sequence[_Place]) -> tuple[Taken, ...]:
        """Returns the frames of these and of the remembered cameras, each in its place as far as possible.

        What a renderer has learnt by a camera's frames belongs to the place.
        """
        counting = {place.name: Taken(place.name, place.newest, place.is_new) for place in members}
        known = self._remembered(members) | counting
        names = [name for name in self._places if name in known]
        first = names.index(members[0].name)
        names[0], names[first] = names[first], names[0]
        return tuple(known[name] for name in names)

    def _remembered(self, members: Sequence[_Place]) -> dict[str, Taken]:
        """Returns what cameras saw last that may be back soon: light stays, and nothing is made for fewer."""
        newest_ns = max(place.newest.received_ns for place in members)
        return {
            place.name: Taken(place.name, place.counted, is_new=False)
            for place in self._places.values()
            if place.counted is not None
            and place.status in ("silent", "other_time")
            and newest_ns - place.counted.received_ns <= REMEMBERED_NS
            and not _sees_another_board(place, members[0])
        }

    def _judge(self, place: _Place, first: _Place, newest: _Place, *, is_silent: bool) -> None:
        status, remark = _status(place, first, newest, is_silent=is_silent)
        if status == "live":
            place.counted = place.newest
        if status == place.status:
            return
        if status == "live":
            log.info("a camera is back", camera=place.name)
        else:
            log.warning("a camera is left out", camera=place.name, reason=remark)
        place.status, place.remark = status, remark


def _status(place: _Place, first: _Place, newest: _Place, *, is_silent: bool) -> tuple[CameraStatus, str]:
    """Returns whether a camera is rendered with the first one, and the sentence that says why not.

    `newest`: whose frame was taken last.
    """
    if is_silent:
        return "silent", f"The camera {place.name} sends no frames; the others continue without it."
    if not _is_of_the_time_of(place, newest):
        return (
            "other_time",
            f"The camera {place.name} is left out: its frames are from a different time than those of {newest.name}.",
        )
    if _sees_another_board(place, first):
        return (
            "other_board",
            f"The camera {place.name} is left out: give its node the board that {first.name} sees.",
        )
    return "live", ""


def _sees_another_board(place: _Place, first: _Place) -> bool:
    board, wanted = place.newest.view.board, first.newest.view.board
    return board is not None and wanted is not None and board != wanted


def _captured_ns(place: _Place) -> int:
    """Returns when a camera's newest frame was taken; 0 where clocks were never compared, or one must be wrong.

    No frame arrives before it was taken.
    """
    header = place.newest.color
    if header.clock_bound_ns is None:
        return 0
    captured_ns = header.capture_ns + header.clock_offset_ns
    is_possible = captured_ns - header.clock_bound_ns <= place.newest.received_ns
    return captured_ns if is_possible else 0


def _is_of_the_time_of(place: _Place, newest: _Place) -> bool:
    """Whether two frames were taken at about the same time; true too where clocks were never compared."""
    one, two = place.newest.color, newest.newest.color
    if one.clock_bound_ns is None or two.clock_bound_ns is None:
        return True
    apart_ns = abs(one.capture_ns + one.clock_offset_ns - two.capture_ns - two.clock_offset_ns)
    return apart_ns - one.clock_bound_ns - two.clock_bound_ns <= max(place.patience_ns, newest.patience_ns)
