"""The viewer page: live picture over a WebSocket, pass times, and the view and operator buttons.

One origin, relative addresses, nothing loaded from elsewhere: it works offline and through an SSH tunnel.
"""

import asyncio
import threading
import uuid
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import structlog
import uvicorn
from fastapi import FastAPI, HTTPException, WebSocket
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, ConfigDict, Field
from starlette.middleware.trustedhost import TrustedHostMiddleware

from protocol.envelope import decode
from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import CompositeMessage, ControlRequest, StatsMessage
from protocol.transport import ReceivedMultipart, Receiver, RequestClient
from services import ports
from services.live import LiveHub

WINDOW = 2  # frames on their way to one browser before it has to acknowledge
RECEIVE_TIMEOUT_S = 0.2
CONTROL_TIMEOUT_S = 5.0
POLICY_VIOLATION = 1008  # WebSocket close code
STATIC_FOLDER = Path(__file__).parent / "static"

log = structlog.get_logger()


class ViewerSettings(BaseModel):
    """Settings of the viewer's process."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    subscribe: str = Field(description="Endpoint of the render server's composites.")
    control: str = Field(description="Endpoint of the render server's commands.")
    port: int = Field(ge=1, le=65535, description="Port of the page, on loopback.")


class Choice(BaseModel):
    """What the page may change; None leaves it."""

    model_config = ConfigDict(extra="forbid")

    view: Literal["composite", "effects", "delta", "volume", "rsm"] | None = None
    operator: Literal["exact", "paper"] | None = None


class SceneControl:
    """Reads and changes the render server's scene through its control socket (any thread)."""

    def __init__(self, control_endpoint: str, keys: Keys | None = None) -> None:
        self._client = RequestClient(control_endpoint, keys=keys)

    def choices(self) -> dict[str, Any]:
        """Name, view and operator of the current scene.

        Raises:
            DeltalightError: no answer.
        """
        scene = self._scene()
        method = scene["method"]
        return {"name": scene["name"], "view": scene["output"]["view"], "operator": method.get("operator")}

    def choose(self, choice: Choice) -> dict[str, Any]:
        """Change view or operator and give the choices as they are then.

        Raises:
            DeltalightError: no answer, or the server refused the change.
        """
        if choice.view is not None:
            self._ask("set_view", {"view": choice.view})
        if choice.operator is not None:
            scene = self._scene()
            # The composition's default goes with the operator, so only the operator changes.
            scene["method"] = {**scene["method"], "name": "dvct", "operator": choice.operator}
            self._ask("set_scene", {"scene": scene}, revision=scene["revision"] + 1)
        return self.choices()

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    def _scene(self) -> dict[str, Any]:
        scene = self._ask("get_scene", {})["scene"]
        assert isinstance(scene, dict)
        return scene

    def _ask(self, op: str, payload: dict[str, object], revision: int | None = None) -> dict[str, object]:
        request = ControlRequest(
            node="viewer", id=uuid.uuid4().hex, op=op, payload=payload, revision=revision
        )
        reply = self._client.request(request, CONTROL_TIMEOUT_S)
        if reply.error is not None:
            raise DeltalightError(reply.error)
        return reply.payload


def create_app(settings: ViewerSettings, keys: Keys | None = None) -> FastAPI:
    """The web application; its stream and control run while the application does."""
    hub = LiveHub()
    control = SceneControl(settings.control, keys)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        receiver = Receiver([settings.subscribe], ["composite", "stats"], keys=keys)
        loop = asyncio.get_running_loop()
        stop = threading.Event()
        feed = threading.Thread(target=_feed, args=(receiver, hub, loop, stop), name="feed", daemon=True)
        feed.start()
        yield
        stop.set()
        receiver.close()
        await run_in_threadpool(feed.join)
        control.close()

    app = FastAPI(title="Deltalight viewer", lifespan=lifespan, docs_url=None, redoc_url=None)
    # A page of another site must not reach this one through a name that resolves to loopback.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[ports.LOOPBACK, "localhost", "[::1]"])
    _add_stream_routes(app, hub)
    _add_scene_routes(app, control)
    app.mount("/static", StaticFiles(directory=STATIC_FOLDER), name="static")
    return app


def run_viewer(settings: ViewerSettings, keys: Keys | None = None) -> None:
    """Serve the page until SIGINT or SIGTERM; `keys` are needed where an endpoint leaves the host.

    Raises:
        DeltalightError: an endpoint is not understood, or the port is in use.
    """
    listener = ports.listen(settings.port)
    config = uvicorn.Config(
        create_app(settings, keys),
        log_level="warning",
        timeout_graceful_shutdown=1,
        ws_max_size=1024,  # browsers send acknowledgements only
        ws_per_message_deflate=False,
    )
    uvicorn.Server(config).run(sockets=[listener])


def _feed(receiver: Receiver, hub: LiveHub, loop: asyncio.AbstractEventLoop, stop: threading.Event) -> None:
    """Carry the newest messages from the receiver's mailbox into the event loop."""
    while not stop.is_set():
        for multipart in (receiver.latest(RECEIVE_TIMEOUT_S) or {}).values():
            _pass_on(multipart, hub, loop)


def _pass_on(multipart: ReceivedMultipart, hub: LiveHub, loop: asyncio.AbstractEventLoop) -> None:
    try:
        message, parts = decode(multipart)
    except DeltalightError as fault:
        log.warning("message not understood", fault=str(fault))
        return
    if isinstance(message, CompositeMessage) and message.encoding == "jpeg":
        loop.call_soon_threadsafe(hub.publish, message, bytes(parts[0]))
    elif isinstance(message, StatsMessage):
        loop.call_soon_threadsafe(hub.note_stats, message)


def _add_stream_routes(app: FastAPI, hub: LiveHub) -> None:
    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(STATIC_FOLDER / "index.html")

    @app.get("/api/v1/health")
    async def health() -> dict[str, Any]:
        return hub.health()

    @app.get("/stream.mjpg", include_in_schema=False)
    async def stream() -> StreamingResponse:
        return StreamingResponse(_mjpeg(hub), media_type="multipart/x-mixed-replace; boundary=frame")

    @app.websocket("/api/v1/live")
    async def live(socket: WebSocket) -> None:
        if not _is_same_origin(socket):
            await socket.close(POLICY_VIOLATION)
            return
        await socket.accept()
        await _stream_to(socket, hub)


def _add_scene_routes(app: FastAPI, control: SceneControl) -> None:
    @app.get("/api/v1/scene/choice")
    async def choices() -> dict[str, Any]:
        return await _answered(run_in_threadpool(control.choices))

    @app.put("/api/v1/scene/choice")
    async def choose(choice: Choice) -> dict[str, Any]:
        return await _answered(run_in_threadpool(control.choose, choice))


async def _answered(answer: Awaitable[dict[str, Any]]) -> dict[str, Any]:
    try:
        return await answer
    except DeltalightError as fault:
        raise HTTPException(503, str(fault)) from fault


def _is_same_origin(socket: WebSocket) -> bool:
    """Browsers send Origin and let any site open a WebSocket; other clients send none."""
    origin = socket.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == socket.headers.get("host")


async def _stream_to(socket: WebSocket, hub: LiveHub) -> None:
    """Send the newest frame whenever this browser acknowledged enough; others are not affected."""
    credits = asyncio.BoundedSemaphore(WINDOW)
    tasks = {
        asyncio.create_task(_send_frames(socket, hub, credits)),
        asyncio.create_task(_take_acknowledgements(socket, credits)),
    }
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _send_frames(socket: WebSocket, hub: LiveHub, credits: asyncio.Semaphore) -> None:
    number = 0
    while True:
        await credits.acquire()
        frame = await hub.newer_than(number)
        number = frame.number
        await socket.send_bytes(frame.packed())


async def _take_acknowledgements(socket: WebSocket, credits: asyncio.Semaphore) -> None:
    while True:
        await socket.receive_text()
        credits.release()


async def _mjpeg(hub: LiveHub) -> AsyncIterator[bytes]:
    number = 0
    while True:
        frame = await hub.newer_than(number)
        number = frame.number
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(frame.jpeg)}\r\n\r\n"
        yield head.encode() + frame.jpeg + b"\r\n"
