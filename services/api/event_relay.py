"""Events of the other web processes that use the same database, for the listeners of this one."""

import json
from collections.abc import Mapping
from functools import partial

from deltalight.protocol.errors import DeltalightError
from deltalight.services.api.context import Context
from deltalight.services.api.events import PASSED_ON, EventType
from deltalight.services.storage.feed import Feed


class EventRelay:
    """Passes events of this process's rooms on, and publishes those of the others in the room of the same name.

    A change of a scene makes the room's link look whether the render server has it.
    """

    def __init__(self, feed: Feed, rooms: Mapping[str, Context]) -> None:
        self._feed = feed
        self._rooms = rooms
        for name, context in rooms.items():
            context.events.pass_on = partial(self._pass_on, name)

    def start(self) -> None:
        """Begins to hear."""
        self._feed.start(self._hear, self._missed)

    def close(self) -> None:
        """Stops."""
        self._feed.close()

    def _pass_on(self, room: str, event: str) -> None:
        self._feed.send(f"{room} {event}")

    def _hear(self, text: str) -> None:
        name, _, event = text.partition(" ")
        context = self._rooms.get(name)
        if context is None:
            return
        body = json.loads(event)
        kind: EventType = body.pop("type")
        if kind not in PASSED_ON:
            raise DeltalightError(f"Another web process sent the event {kind!r:.40}, which stays in its own.")
        if kind == "scene":
            context.link.look_again()
        context.heard.hear(kind, body)
        context.events.deliver(kind, body)

    def _missed(self) -> None:
        """Makes listeners and render servers look at everything again."""
        for context in self._rooms.values():
            context.link.look_again()
            context.events.deliver("lost", {"count": 0})
