"""Addresses of a room: `/api/v1/rooms/NAME/...` is `/api/v1/...` of the room NAME."""

import re

from starlette.types import ASGIApp, Receive, Scope, Send

from deltalight.services.api.context import ROOM_KEY

OWN = ("drain", "start", "move")  # routes of rooms themselves
_PATH = re.compile(r"(?P<api>/api/v1/)rooms/(?P<room>[^/]+)/(?P<rest>.+)")


class RoomPaths:
    """Middleware that lets every route be used for a room.

    It comes before all others, so that rights, limits and measurements are those of the route.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, with its room noted and left out of its path."""
        match = _PATH.fullmatch(scope["path"]) if scope["type"] in ("http", "websocket") else None
        if match is not None and match["rest"] not in OWN:
            path = match["api"] + match["rest"]
            scope = {**scope, ROOM_KEY: match["room"], "path": path, "raw_path": path.encode()}
        await self._app(scope, receive, send)
