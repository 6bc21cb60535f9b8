"""Routes of the rooms: which there are, how they are doing, and where they run."""

from collections.abc import Callable, Sequence
from typing import Annotated

from fastapi import Body, Depends, Path
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import HTTPConnection

from deltalight.protocol.documents import NAME_PATTERN
from deltalight.protocol.errors import DeltalightError
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Context, Shared, in_pool
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.api.rooms import Rooms
from deltalight.services.rooms.directory import (
    DRAIN,
    DRAIN_HOST,
    MOVE,
    START,
    UNDRAIN_HOST,
    DirectoryClient,
    SilentDirectoryError,
)
from deltalight.services.rooms.status import HOST_PATTERN, RoomList, RoomState, RoomStatus, SlotStatus
from deltalight.services.storage.faults import ConflictError, NotFoundError, StorageFaultError

router = api_router(tags=["rooms"])
ROUTERS = (router,)

NO_DIRECTORY = "The directory of rooms does not respond, or (with Retry-After) has too many pending requests."
SILENT = "The render server does not answer yet."


class RoomScene(BaseModel):
    """The scene that a room shows."""

    id: str
    name: str
    revision: int
    method: str = Field(description="The relighting method.")


class RoomAnswer(BaseModel):
    """A room: its nodes, its scene and its state."""

    name: str = Field(description="Name in URLs: every route also exists as `/rooms/NAME/...` for this room.")
    title: str = Field(description="For people.")
    state: RoomState = Field(
        description="`waiting` (for a slot, or drained), `starting`, `running`, or `failed` until it is "
        "restarted."
    )
    why: str = Field(description="Why the room is waiting, failed, or shows nothing; else empty.")
    nodes: list[str] = Field(description="Its sensor nodes.")
    scene: RoomScene | None
    slot: str | None = Field(
        description="Slot in which its render server runs; null = none, or a single room."
    )
    moving_to: str | None = Field(description="Slot in which its next render server will start.")
    epoch: int | None = Field(description="Increases with each start of its render server.")
    restarts: int = Field(description="How often its render server was lost and replaced.")
    frames_per_s: float | None = Field(description="Of its pictures.")
    last_frame_s: float | None = Field(description="Seconds since its newest picture arrived.")


class RoomsAnswer(BaseModel):
    """All rooms and slots."""

    rooms: list[RoomAnswer]
    slots: list[SlotStatus] = Field(description="Empty for a single room.")
    can_move: bool = Field(description="Whether this installation can drain, start and move rooms.")


class HostAnswer(BaseModel):
    """A host that renders."""

    name: str
    drained: bool = Field(description="Whether it is drained: no room starts there.")
    slots: int = Field(description="Number of rooms that it can render at once; 0 = it is not connected.")
    rooms: list[str] = Field(description="Rooms that it renders.")


class MoveOrder(BaseModel):
    """Slot to move a room to."""

    model_config = ConfigDict(extra="forbid", strict=True)

    slot: str | None = Field(default=None, max_length=64, description="A free slot; null = any.")


async def _rooms(connection: HTTPConnection) -> Rooms:
    rooms = connection.app.state.rooms
    assert isinstance(rooms, Rooms)
    return rooms


AllRooms = Annotated[Rooms, Depends(_rooms)]
HostName = Annotated[
    str,
    Path(description="The host's `name`.", pattern=HOST_PATTERN, examples=["local"]),
]
RoomName = Annotated[str, Path(description="The room's `name`.", pattern=NAME_PATTERN, examples=["room"])]


@router.get("/rooms")
def list_rooms(rooms: AllRooms) -> RoomsAnswer:
    """List all rooms and slots."""
    return _answer(rooms)


@router.get("/rooms/{room}", responses=responses(404))
def get_room(rooms: AllRooms, room: RoomName) -> RoomAnswer:
    """Return one room."""
    return _one(_answer(rooms), room)


@router.post("/rooms/{room}/drain", responses={**responses(404, 409), **unavailable(NO_DIRECTORY)})
@in_pool("render server")
def drain_room(shared: Shared, rooms: AllRooms, room: RoomName) -> RoomAnswer:
    """Stop the room's render server until it is started again; waiting rooms can use its slot."""
    del shared
    return _commanded(rooms, DRAIN, room)


@router.post("/rooms/{room}/start", responses={**responses(404, 409), **unavailable(NO_DIRECTORY)})
@in_pool("render server")
def start_room(shared: Shared, rooms: AllRooms, room: RoomName) -> RoomAnswer:
    """Start a room that was drained or that failed."""
    del shared
    return _commanded(rooms, START, room)


@router.post("/rooms/{room}/move", responses={**responses(400, 404, 409), **unavailable(NO_DIRECTORY)})
@in_pool("render server")
def move_room(
    shared: Shared,
    rooms: AllRooms,
    room: RoomName,
    order: Annotated[MoveOrder, Body(examples=[{"slot": "slot-2"}])],
) -> RoomAnswer:
    """Move the room to another slot; the old slot keeps rendering it until the new one sends pictures."""
    del shared
    return _commanded(rooms, MOVE, room, order.slot)


@router.get("/hosts")
def list_hosts(rooms: AllRooms) -> list[HostAnswer]:
    """List the hosts that provide slots; empty for a single room."""
    return _hosts(_answer(rooms).slots)


@router.post("/hosts/{host}/drain", responses={**responses(404, 409), **unavailable(NO_DIRECTORY)})
@in_pool("render server")
def drain_host(shared: Shared, rooms: AllRooms, host: HostName) -> HostAnswer:
    """Move the host's rooms to other hosts, one after another; rooms without a slot there stop and wait.

    It stays drained over restarts, until that is deleted.
    """
    del shared
    if all(each.name != host for each in list_hosts(rooms)):
        raise NotFoundError(f"there is no host {host!r:.80} with a slot; list the hosts for their names.")
    return _host(_ordered(rooms, lambda directory: directory.host_command(DRAIN_HOST, host)), host)


@router.delete("/hosts/{host}/drain", responses={**responses(404, 409), **unavailable(NO_DIRECTORY)})
@in_pool("render server")
def undrain_host(shared: Shared, rooms: AllRooms, host: HostName) -> HostAnswer:
    """Allow rooms to start on the host again."""
    del shared
    return _host(_ordered(rooms, lambda directory: directory.host_command(UNDRAIN_HOST, host)), host)


def _hosts(slots: Sequence[SlotStatus]) -> list[HostAnswer]:
    return [_host_of(name, slots) for name in dict.fromkeys(slot.host for slot in slots)]


def _host(found: RoomList, name: str) -> HostAnswer:
    return _host_of(name, found.slots)


def _host_of(name: str, slots: Sequence[SlotStatus]) -> HostAnswer:
    own = [slot for slot in slots if slot.host == name]
    rooms = [slot.room for slot in own if slot.room is not None]
    return HostAnswer(name=name, drained=any(slot.drained for slot in own), slots=len(own), rooms=rooms)


def _commanded(rooms: Rooms, op: str, room: str, slot: str | None = None) -> RoomAnswer:
    _one(_answer(rooms), room)
    found = _ordered(rooms, lambda directory: directory.command(op, room, slot))
    return _one(_described(rooms.contexts, found), room)


def _ordered(rooms: Rooms, order: Callable[[DirectoryClient], RoomList]) -> RoomList:
    """Gives an order to the directory, and returns all rooms after it."""
    if rooms.directory is None:
        raise ConflictError(
            "this installation has a single room, which stays where it is; for several, use `deltalight up --rooms`."
        )
    try:
        return order(rooms.directory)
    except SilentDirectoryError as fault:
        raise ProblemError(503, "directory", str(fault)) from fault
    except StorageFaultError:  # 503 as well
        raise
    except DeltalightError as refusal:
        raise ConflictError(str(refusal)) from refusal


def _answer(rooms: Rooms) -> RoomsAnswer:
    if rooms.follower is None:
        (context,) = rooms.contexts.values()
        return RoomsAnswer(rooms=[_single(context)], slots=[], can_move=False)
    return _described(rooms.contexts, rooms.follower.newest)


def _described(contexts: dict[str, Context], found: RoomList) -> RoomsAnswer:
    answers = [_room(contexts[each.name], each) for each in found.rooms if each.name in contexts]
    return RoomsAnswer(rooms=answers, slots=list(found.slots), can_move=True)


def _one(answer: RoomsAnswer, room: str) -> RoomAnswer:
    found = next((each for each in answer.rooms if each.name == room), None)
    if found is None:
        raise NotFoundError(f"there is no room {room!r:.80}; list the rooms for their names.")
    return found


def _room(context: Context, status: RoomStatus) -> RoomAnswer:
    _, since_s = context.live.state()
    return RoomAnswer(
        name=status.name,
        title=status.title,
        state=status.state,
        why=status.why,
        nodes=[node.name for node in status.nodes],
        scene=_scene(context),
        slot=status.slot,
        moving_to=status.moving_to,
        epoch=None if status.endpoints is None else status.endpoints.epoch,
        restarts=status.restarts,
        frames_per_s=context.live.frames_per_s(),
        last_frame_s=None if since_s is None else round(since_s, 3),
    )


def _single(context: Context) -> RoomAnswer:
    _, since_s = context.live.state()
    reports = [report.message.node for report in context.watch.reports()]
    return RoomAnswer(
        name=context.room,
        title=context.room,
        state="running" if context.link.is_reachable else "starting",
        why="" if context.link.is_reachable else SILENT,
        nodes=[name for name in reports if name != context.server_name],
        scene=_scene(context),
        slot=None,
        moving_to=None,
        epoch=None,
        restarts=0,
        frames_per_s=context.live.frames_per_s(),
        last_frame_s=None if since_s is None else round(since_s, 3),
    )


def _scene(context: Context) -> RoomScene | None:
    scene = context.store.scenes.active()
    if scene is None:
        return None
    head = scene.head
    return RoomScene(
        id=head.id, name=head.name, revision=head.revision, method=scene.document.method.method_name()
    )
