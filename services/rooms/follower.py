"""Follows the directory of rooms: the newest endpoints of each room, and no older ones."""

import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Protocol

import structlog

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.message_fields import as_sentence
from deltalight.services.rooms.directory import DirectoryClient
from deltalight.services.rooms.status import RoomEndpoints, RoomList, RoomStatus

POLL_INTERVAL_S = 0.2

log = structlog.get_logger()


class Directory(Protocol):
    """Knows all rooms (`directory.DirectoryClient`)."""

    def rooms(self) -> RoomList:
        """Returns all rooms and slots; raises DeltalightError where it does not answer."""


class RoomFollower:
    """Asks a directory five times a second, in a thread between `start` and `close`.

    Calls `on_endpoints(room, endpoints)` for each room whose render server is another, newer one, or (None) is gone,
    and `on_change` when anything changed. Endpoints of an epoch before the newest are `refused`, and counted: a
    directory or a render server that was cut off and comes back must not take the room over. What it refuses or
    cannot use is said once, and leaves the other rooms alone.
    """

    def __init__(
        self,
        directory: Directory,
        on_endpoints: Callable[[str, RoomEndpoints | None], None],
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._directory = directory
        self._on_endpoints, self._on_change = on_endpoints, on_change
        self._epochs: dict[str, int] = {}  # the newest of each room
        self._followed: dict[str, RoomEndpoints | None] = {}
        self._stale: dict[str, int] = {}  # the epoch of each room that was refused last
        self.refused = 0
        self.newest = RoomList(rooms=(), slots=())
        self.is_answered = True  # the last question
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="room-follower", daemon=True)

    def start(self) -> None:
        """Starts to follow."""
        self._thread.start()

    def close(self) -> None:
        """Stops following."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def look(self) -> None:
        """Asks once.

        Raises:
            DeltalightError: the directory does not answer.
        """
        self.take(self._directory.rooms())

    def take(self, found: RoomList) -> None:
        """Follows what a directory says."""
        for room in found.rooms:
            self._follow(room.name, room.endpoints)
        before, self.newest = self.newest, found
        if found != before:
            self._on_change()

    def _follow(self, room: str, endpoints: RoomEndpoints | None) -> None:
        if endpoints is not None and endpoints.epoch < self._epochs.get(room, 0):
            self._refuse(room, endpoints.epoch)
            return
        if endpoints == self._followed.get(room):
            return
        if endpoints is not None:
            self._epochs[room] = endpoints.epoch
        self._followed[room] = endpoints
        try:
            self._on_endpoints(room, endpoints)
        except DeltalightError as fault:
            log.warning("the endpoints of a room cannot be used", room=room, fault=as_sentence(str(fault)))

    def _refuse(self, room: str, epoch: int) -> None:
        self.refused += 1
        if self._stale.get(room) != epoch:
            self._stale[room] = epoch
            log.warning("stale endpoints refused", room=room, epoch=epoch, newest=self._epochs[room])

    def _run(self) -> None:
        while not self._stop.wait(POLL_INTERVAL_S):
            try:
                self.look()
                self.is_answered = True
            except DeltalightError as fault:
                if self.is_answered:
                    log.warning("the directory of rooms does not answer", fault=str(fault))
                self.is_answered = False


@contextmanager
def following(
    directory: str, room: str, keys: Keys | None, use: Callable[[str | None], None]
) -> Iterator[None]:
    """Calls `use` with the endpoint at which a room's render server publishes, now and whenever it is another.

    None = it has none; so it is told at the end.

    Raises:
        DeltalightError: the directory does not answer, or has no such room.
    """
    client = DirectoryClient(directory, keys)

    def follow(name: str, endpoints: RoomEndpoints | None) -> None:
        if name == room:
            use(None if endpoints is None else endpoints.publish)

    with closing(client):
        follower = RoomFollower(client, follow)
        follower.look()
        _find(follower.newest, room)
        follower.start()
        try:
            yield
        finally:
            follower.close()
            use(None)


def streams_of_room(directory: str, room: str, node: str | None, keys: Keys | None) -> str:
    """Returns the endpoint of a room's node of this name, None = its first.

    Raises:
        DeltalightError: the directory does not answer, or has no such room, or the room no such node.
    """
    with closing(DirectoryClient(directory, keys)) as client:
        nodes = _find(client.rooms(), room).nodes
    found = next((each for each in nodes if node in (None, each.name)), None)
    if found is None:
        known = ", ".join(each.name for each in nodes)
        raise DeltalightError(f"the room {room} has no node {str(node)[:80]}; choose one of {known}.")
    return found.endpoint


def _find(found: RoomList, room: str) -> RoomStatus:
    status = next((each for each in found.rooms if each.name == room), None)
    if status is None:
        names = [each.name for each in found.rooms]
        known = nearest(room, names) or ", ".join(names) or "none"
        raise DeltalightError(f"there is no room {room[:80]}; did you mean {known}?")
    return status
