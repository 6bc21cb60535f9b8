"""The WebSocket on which clients hear what happens."""

from importlib.metadata import version

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from services.api.context import Shared
from services.api.events import EventQueue, packed
from services.api.live import POLICY_VIOLATION, first_of
from services.api.passes import pass_of

router = APIRouter(tags=["state"])


@router.websocket("/events")
async def events(socket: WebSocket, shared: Shared) -> None:
    """Send every event from now on."""
    await socket.accept()
    with shared.events.listening() as queue:
        role = pass_of(socket.scope).role
        await socket.send_text(packed("hello", {"version": version("deltalight"), "role": role}))
        await first_of(_send_events(socket, queue), _expect_nothing(socket))


async def _send_events(socket: WebSocket, queue: EventQueue) -> None:
    while True:
        await socket.send_text(await queue.next())


async def _expect_nothing(socket: WebSocket) -> None:
    """Wait for the end; who sends something here is in the wrong place."""
    try:
        await socket.receive_text()
    except (WebSocketDisconnect, KeyError):
        return
    await socket.close(POLICY_VIOLATION, "nothing is taken here")
