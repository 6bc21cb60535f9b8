"""Options of commands that use the relit pictures of a room, whichever render server it has."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.errors import DeltalightError
from deltalight.services.ports import COMPOSITE_PORT, endpoint

if TYPE_CHECKING:
    from deltalight.protocol.keys import Keys, KeySettings
    from deltalight.services.picture_source import PictureSource

Rooms = Annotated[
    str | None,
    typer.Option(help="Directory of rooms (`up --rooms`) that has --room, such as tcp://127.0.0.1:5604."),
]
Room = Annotated[
    str | None,
    typer.Option(help="Room of --rooms whose relit pictures to use, whichever render server it has."),
]
Composites = Annotated[
    str | None,
    typer.Option(
        help="Endpoint at which the render server publishes relit pictures. Default: tcp://127.0.0.1:5602."
    ),
]


@contextmanager
def following_room(
    rooms: str | None, room: str | None, keys: "Keys | None", use: Callable[[str | None], None]
) -> Iterator[None]:
    """Calls `use` with the endpoints of a room (`follower.following`), if one is named.

    Raises:
        DeltalightError: one option is without the other, the directory does not answer, or has no such room.
    """
    if (rooms is None) != (room is None):
        raise DeltalightError(
            "--rooms and --room belong together: give the directory of rooms and one of its rooms."
        )
    if rooms is None or room is None:
        yield
        return
    from deltalight.services.rooms.follower import following

    with following(rooms, room, keys, use):
        yield


@contextmanager
def relit_pictures(
    composites: str | None, rooms: str | None, room: str | None, camera: str | None, keys: "KeySettings"
) -> "Iterator[tuple[PictureSource, str]]":
    """Yields the pictures of a render server or a room, and what to call where they come from.

    Raises:
        DeltalightError: the options contradict each other, or as `following_room` and `PictureSource.follow`.
    """
    from contextlib import closing

    from deltalight.services.picture_source import PictureSource

    if composites is not None and (rooms is not None or room is not None):
        raise DeltalightError("--composites and --rooms both say where pictures come from; give one of them.")
    place = composites or endpoint(COMPOSITE_PORT)
    directory_keys = keys.load([place if rooms is None else rooms])
    with closing(PictureSource(camera, keys)) as source:
        if room is None:
            source.follow(place)
        with following_room(rooms, room, directory_keys, source.follow):
            yield source, place if room is None else f"the room {room}"
