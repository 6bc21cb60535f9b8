"""The directory of rooms: who asks it learns where each room's render server is now, and may move or drain rooms.

It answers at an endpoint of its own that never changes (and what the time is, so that nodes compare clocks with it);
the endpoints of render servers change with every placement.
"""

import time
import uuid
from collections.abc import Callable, Mapping

from deltalight.protocol.clock import CLOCK_OP, clock_payload
from deltalight.protocol.documents import nearest, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import ReplyServer, RequestClient
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.rooms.status import RoomList
from deltalight.services.storage.faults import StorageFaultError

ANSWER_TIMEOUT_S = 2.0
LIST, DRAIN, START, MOVE = "rooms", "drain", "start", "move"
DRAIN_HOST, UNDRAIN_HOST = "drain-host", "undrain-host"
STORAGE_FAULT = "storage_fault"  # in place of the rooms: why a command could not be stored, which passes


class SilentDirectoryError(DeltalightError):
    """The directory of rooms did not answer."""


class DirectoryServer:
    """Answers for a keeper, until `close`.

    Raises:
        DeltalightError: the endpoint cannot be used.
    """

    def __init__(self, endpoint: str, keeper: RoomKeeper, keys: Keys | None = None) -> None:
        self._keeper = keeper
        self._replies = ReplyServer(endpoint, self._execute, node="rooms", keys=keys)

    def close(self) -> None:
        """Stops answering."""
        self._replies.close()

    def _execute(self, request: ControlRequest) -> dict[str, object]:
        commands: Mapping[str, Callable[[], None]] = {
            DRAIN: lambda: self._keeper.drain(_word(request, "room")),
            START: lambda: self._keeper.start(_word(request, "room")),
            MOVE: lambda: self._keeper.move(_word(request, "room"), _optional_word(request, "slot")),
            DRAIN_HOST: lambda: self._keeper.drain_host(_word(request, "host")),
            UNDRAIN_HOST: lambda: self._keeper.undrain_host(_word(request, "host")),
        }
        if request.op == CLOCK_OP:
            return clock_payload(time.time_ns())
        if request.op in commands:
            try:
                commands[request.op]()
            except StorageFaultError as fault:
                return {STORAGE_FAULT: str(fault)}
        elif request.op not in (LIST, "ping"):
            known = (LIST, *commands)
            hint = nearest(request.op, known) or ", ".join(known)
            raise DeltalightError(
                f"the directory of rooms has no command '{request.op}'; did you mean {hint}?"
            )
        return self._keeper.status().model_dump(mode="json")


class DirectoryClient:
    """Asks a directory; any thread may."""

    def __init__(self, endpoint: str, keys: Keys | None = None) -> None:
        self._client = RequestClient(endpoint, keys=keys)

    def close(self) -> None:
        """Closes the connection."""
        self._client.close()

    def rooms(self) -> RoomList:
        """Returns all rooms and slots.

        Raises:
            SilentDirectoryError: the directory does not answer.
        """
        return self._ask(LIST)

    def command(self, op: str, room: str, slot: str | None = None) -> RoomList:
        """Drains, starts or moves a room, and returns all rooms after it.

        Raises:
            SilentDirectoryError: the directory does not answer.
            StorageFaultError: it cannot store that now.
            DeltalightError: it refuses.
        """
        return self._ask(op, {"room": room, **({} if slot is None else {"slot": slot})})

    def host_command(self, op: str, host: str) -> RoomList:
        """Drains a host or ends that, and returns all rooms after it.

        Raises:
            SilentDirectoryError: the directory does not answer.
            StorageFaultError: it cannot store that now.
            DeltalightError: it refuses.
        """
        return self._ask(op, {"host": host})

    def _ask(self, op: str, payload: dict[str, object] | None = None) -> RoomList:
        request = ControlRequest(
            node="rooms", capture_ns=time.time_ns(), id=uuid.uuid4().hex, op=op, payload=payload or {}
        )
        try:
            reply = self._client.request(request, ANSWER_TIMEOUT_S)
        except DeltalightError as fault:
            raise SilentDirectoryError(
                f"the directory of rooms does not answer ({str(fault).rstrip('.')});"
                " check that `deltalight up --rooms` is running."
            ) from fault
        if reply.error is not None:
            raise DeltalightError(reply.error)
        if STORAGE_FAULT in reply.payload:
            raise StorageFaultError(str(reply.payload[STORAGE_FAULT]))
        return validate(RoomList, reply.payload, "the directory's answer")


def _word(request: ControlRequest, key: str) -> str:
    word = request.payload.get(key)
    if not isinstance(word, str):
        raise DeltalightError(
            f"the command {request.op} needs the name of a {key} as `{key}` in its payload."
        )
    return word


def _optional_word(request: ControlRequest, key: str) -> str | None:
    return None if request.payload.get(key) is None else _word(request, key)
