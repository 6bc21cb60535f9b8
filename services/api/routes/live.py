"""Routes of live data: the composite, picking, the fish-eye picture, events."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from fastapi import Body, Query, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from deltalight import __version__
from deltalight.protocol.message_fields import MAX_EDGE_PX
from deltalight.protocol.messages import RadianceMessage
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Shared, in_pool
from deltalight.services.api.credentials import TICKET_LIFE_S, principal_of
from deltalight.services.api.events import EventQueue, packed
from deltalight.services.api.file_response import StoredFileResponse
from deltalight.services.api.fisheye import FisheyeLight, lights_in_picture
from deltalight.services.api.limits import RateLimit
from deltalight.services.api.live_hub import LiveHub, Viewer
from deltalight.services.api.live_video import LiveCodec
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.coroutines import run_until_first_ends
from deltalight.services.storage.faults import NotFoundError

PICK_TIMEOUT_S = 5.0  # some frames of the slowest renderer
VIEW_TIMEOUT_S = 10.0  # the same, and its shaders' compilation
POLICY_VIOLATION, GOING_AWAY = 1008, 1001  # WebSocket close codes (RFC 6455, 7.4.1)
CLOSE_REASON_BYTES = 123  # (5.5)
ORDERS_PER_S, ORDERS_AT_ONCE = 10.0, 40  # changes of view and codec by one viewer, which are work for all
BOUNDARY = "frame"
CODECS: dict[str, LiveCodec] = {"jpeg": "jpeg", "h264": "h264"}
_TOO_MANY_ORDERS = "change view, camera and codec less often"
VIEWS: dict[str, ShownView] = {name: name for name in get_args(ShownView)}
UNKNOWN_VIEW = f"there is no such view; ask for one of {', '.join(VIEWS)}"
UNKNOWN_CODEC = f"there is no such codec; ask for one of {', '.join(CODECS)}"
PICTURE_HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
RETRY_AFTER_S = "1"  # pictures come many times a second, or not for a while
NO_ANSWER = (
    "The render server does not respond, or has too many pending requests; try again after Retry-After."
)
JPEG_ANSWER: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": {}}}}

WantedView = Annotated[
    ShownView | None, Query(description="View to return; default: the scene's `output.view`.")
]
WantedCamera = Annotated[
    str | None,
    Query(max_length=64, description="Name of the camera's node; default: the first camera."),
]

live_router = api_router(tags=["live"])
events_router = api_router(tags=["state"])
ROUTERS = (live_router, events_router)


class TicketAnswer(BaseModel):
    """A ticket for one URL."""

    ticket: str = Field(description="Ticket to add to the URL as `?ticket=...`.")
    expires_s: float = Field(
        description="Seconds for which it is valid, for one use.", examples=[TICKET_LIFE_S]
    )


class Pick(BaseModel):
    """What a pixel of the newest composite shows; points are metres in the world."""

    frame_id: int = Field(description="The frame that was examined.")
    kind: Literal["real", "object", "nothing"]
    object: str | None = Field(description="Id of the virtual object; else null.")
    point_m: tuple[float, float, float] | None = Field(
        description="Point on the surface; null if there is none."
    )
    normal: tuple[float, float, float] | None = Field(description="Its unit normal; null if unknown.")
    distance_m: float | None = Field(description="Distance from the camera; null if there is no surface.")


class Pixel(BaseModel):
    """A place in the composite."""

    model_config = ConfigDict(strict=True)

    x: float = Field(
        ge=-0.5, le=MAX_EDGE_PX, description="Pixels to the right; the centre of the first pixel is 0."
    )
    y: float = Field(ge=-0.5, le=MAX_EDGE_PX, description="Pixels down; the centre of the first pixel is 0.")
    ignore: str | None = Field(
        None,
        max_length=200,
        description="Id of an object to ignore, such as the one being dragged, to pick the real scene behind it.",
    )
    camera: str | None = Field(
        None, max_length=64, description="Name of the camera's node; null = the first camera."
    )


class FisheyeAnswer(BaseModel):
    """The size of the fish-eye picture and the lights visible in it."""

    seen_ns: int = Field(description="Capture time, ns since 1970 by the node's clock.")
    node: str = Field(description="Node of the fish-eye camera.")
    width: int = Field(description="Size of the picture, pixels.")
    height: int
    clipped_share: float = Field(description="Fraction of the visible area that was too bright to measure.")
    lights: list[FisheyeLight]


@live_router.post("/tickets", status_code=201)
def create_ticket(shared: Shared, request: Request) -> TicketAnswer:
    """Get a ticket with the caller's role, for requests that cannot carry a token: WebSockets and pictures."""
    return TicketAnswer(ticket=shared.tickets.issue(principal_of(request.scope)), expires_s=TICKET_LIFE_S)


@live_router.websocket("/live")
async def live(
    socket: WebSocket,
    shared: Shared,
    view: str | None = None,
    codec: str = "jpeg",
    camera: str | None = None,
) -> None:
    """Send the newest frame whenever this viewer acknowledged enough; others are not affected.

    Wrong parameters are refused after the handshake: browsers do not tell pages why one failed.
    """
    await socket.accept()
    refusal = "" if view is None or view in VIEWS else UNKNOWN_VIEW
    refusal = refusal or ("" if codec in CODECS else UNKNOWN_CODEC)
    refusal = refusal or _why_not(shared.live, camera)
    if refusal:
        await socket.close(POLICY_VIOLATION, refusal)
        return
    under_way = _UnderWay()
    with shared.live.viewer(VIEWS.get(view or ""), CODECS[codec], camera) as viewer:
        await run_until_first_ends(
            _send_frames(socket, viewer, under_way), _take_messages(socket, viewer, under_way)
        )


@live_router.get("/live.mjpg", include_in_schema=False)  # it never ends, which its description cannot express
async def live_mjpeg(
    shared: Shared, view: WantedView = None, camera: WantedCamera = None
) -> StreamingResponse:
    """Stream the newest frames as one endless multipart response, for pictures in web pages."""
    shared.live.require(camera)
    media_type = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
    return StreamingResponse(
        _mjpeg(shared.live, view, camera), media_type=media_type, headers=PICTURE_HEADERS
    )


@live_router.get(
    "/live.jpg",
    response_class=Response,
    responses={
        **responses(404),
        **unavailable("No picture has arrived from the render server yet."),
        **JPEG_ANSWER,
    },
)
async def live_picture(shared: Shared, view: WantedView = None, camera: WantedCamera = None) -> Response:
    """Return the newest composite; with `view`, the next one, in that view."""
    shared.live.require(camera)
    frame = shared.live.newest_of(camera)
    if frame is None:
        sentence = "No picture has come from the render server yet; see /state."
        raise ProblemError(503, "no-picture", sentence, {"Retry-After": RETRY_AFTER_S})
    jpeg = frame.picture(None).jpeg if view is None else await _next_in(shared.live, view, camera)
    return Response(jpeg, media_type="image/jpeg", headers=PICTURE_HEADERS)


@live_router.get(
    "/poster.jpg", response_class=StoredFileResponse, responses={**responses(404), **JPEG_ANSWER}
)
def poster(shared: Shared) -> StoredFileResponse:
    """Return the still that is shown until the first live picture; `/settings` says whether there is one."""
    return _still(shared.store.poster)


@live_router.get(
    "/poster-before.jpg", response_class=StoredFileResponse, responses={**responses(404), **JPEG_ANSWER}
)
def poster_before(shared: Shared) -> StoredFileResponse:
    """Return the camera's own picture of the still's frame; `/settings` says whether there is one."""
    return _still(shared.store.poster_before)


def _still(path: Path) -> StoredFileResponse:
    if not path.is_file():
        raise NotFoundError("there is no poster; wait for the live picture.")
    return StoredFileResponse(path, media_type="image/jpeg", headers=PICTURE_HEADERS)


@live_router.post("/live/pick", responses={**responses(400, 404), **unavailable(NO_ANSWER)})
@in_pool("render server")
def pick(shared: Shared, pixel: Annotated[Pixel, Body(examples=[{"x": 320, "y": 200}])]) -> Pick:
    """Return what a pixel of the newest composite shows: where to put an object, or which object was clicked."""
    shared.live.require(pixel.camera)
    payload = pixel.model_dump(exclude_none=True)
    return Pick.model_validate(shared.link.command("pick", payload, PICK_TIMEOUT_S))


@live_router.get("/fisheye", responses=responses(404))
def fisheye(shared: Shared) -> FisheyeAnswer:
    """Return what the fish-eye camera sees: the size of its picture and the positions of the lights in it."""
    message, _ = _newest_fisheye(shared)
    frame = shared.live.newest
    height, width = message.picture_shape[:2]
    return FisheyeAnswer(
        seen_ns=message.capture_ns,
        node=message.node,
        width=width,
        height=height,
        clipped_share=message.clipped_share,
        lights=lights_in_picture(message, () if frame is None else frame.message.lights),
    )


@live_router.get("/fisheye.jpg", response_class=Response, responses={**responses(404), **JPEG_ANSWER})
def fisheye_picture(shared: Shared) -> Response:
    """Return the newest fish-eye picture."""
    return Response(_newest_fisheye(shared)[1], media_type="image/jpeg", headers=PICTURE_HEADERS)


@events_router.websocket("/events")
async def events(socket: WebSocket, shared: Shared) -> None:
    """Send every event from now on."""
    await socket.accept()
    with shared.events.listening() as queue:
        role = principal_of(socket.scope).role
        await socket.send_text(packed("hello", {"version": __version__, "role": role}))
        await run_until_first_ends(_send_events(socket, queue), _expect_nothing(socket))


class _UnderWay:
    """Counts the messages that a viewer has not acknowledged yet."""

    def __init__(self) -> None:
        self._count = 0
        self._acknowledged = asyncio.Event()

    async def wait_for(self, viewer: Viewer) -> None:
        """Waits until another one may be sent."""
        while self._count >= viewer.window:
            self._acknowledged.clear()
            await self._acknowledged.wait()

    def add(self) -> None:
        """Counts a message that is sent."""
        self._count += 1

    def acknowledge(self) -> None:
        """Counts an acknowledgement.

        Raises:
            ValueError: nothing is under way.
        """
        if self._count == 0:
            raise ValueError
        self._count -= 1
        self._acknowledged.set()


async def _send_frames(socket: WebSocket, viewer: Viewer, under_way: _UnderWay) -> None:
    while True:
        await under_way.wait_for(viewer)
        message = await viewer.next_message()
        if message is None:
            await socket.close(GOING_AWAY)
            return
        under_way.add()
        await socket.send_bytes(message)


async def _take_messages(socket: WebSocket, viewer: Viewer, under_way: _UnderWay) -> None:
    """Takes acknowledgements, and what the viewer orders: `view NAME`, `camera NAME`, `codec NAME`.

    `view` alone is the scene's own, `camera` alone the first one.
    """
    orders = RateLimit(ORDERS_PER_S, ORDERS_AT_ONCE)
    try:
        while True:
            text = await socket.receive_text()
            if not text.startswith(("view", "camera", "codec")):
                under_way.acknowledge()
                continue
            refusal = _TOO_MANY_ORDERS if orders.wait_s("") > 0 else _obey(viewer, text)
            if refusal:
                await socket.close(POLICY_VIOLATION, refusal)
                return
            orders.take("")
    except WebSocketDisconnect:
        return
    except (ValueError, KeyError):  # it acknowledged a frame that it never got, or sent bytes
        await socket.close(POLICY_VIOLATION, "send `ack` as text, once for each frame")


def _obey(viewer: Viewer, order: str) -> str:
    """Shows a viewer another view or camera, or in another codec; returns why not, else nothing."""
    if order.startswith("view"):
        name = order.removeprefix("view").strip()
        if name and name not in VIEWS:
            return UNKNOWN_VIEW
        viewer.look_at(VIEWS.get(name))
        return ""
    if order.startswith("camera"):
        camera = order.removeprefix("camera").strip() or None
        refusal = _why_not(viewer.hub, camera)
        if not refusal:
            viewer.turn_to(camera)
        return refusal
    codec = CODECS.get(order.removeprefix("codec").strip())
    if codec is None:
        return UNKNOWN_CODEC
    viewer.prefer(codec)
    return ""


def _why_not(hub: LiveHub, camera: str | None) -> str:
    """Returns why a camera cannot be watched, in as many bytes as fit the close of a WebSocket; else nothing."""
    try:
        hub.require(camera)
    except NotFoundError as fault:
        return str(fault).encode()[:CLOSE_REASON_BYTES].decode(errors="ignore")
    return ""


async def _next_in(hub: LiveHub, view: ShownView, camera: str | None) -> bytes:
    """Returns a camera's next picture in a view.

    Raises:
        ProblemError: none came in time.
    """
    with hub.viewer(view, camera=camera) as viewer:
        try:
            async with asyncio.timeout(VIEW_TIMEOUT_S):
                while (frame := await viewer.next()) is not None:
                    if view in frame.pictures:
                        return frame.pictures[view].jpeg
        except TimeoutError:
            pass
    sentence = f"No picture in the view {view} has come; see /state."
    raise ProblemError(503, "no-picture", sentence, {"Retry-After": RETRY_AFTER_S})


async def _mjpeg(hub: LiveHub, view: ShownView | None, camera: str | None) -> AsyncIterator[bytes]:
    with hub.viewer(view, camera=camera) as viewer:
        while (frame := await viewer.next()) is not None:
            yield _part(frame.picture(view).jpeg)


def _part(jpeg: bytes) -> bytes:
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
    return head.encode() + jpeg + b"\r\n"


def _newest_fisheye(shared: Shared) -> tuple[RadianceMessage, bytes]:
    newest = shared.fisheye.newest
    if newest is None:
        raise NotFoundError(
            "no node has sent light of a fish-eye camera; docs/fisheye.md says how to set one up."
        )
    return newest


async def _send_events(socket: WebSocket, queue: EventQueue) -> None:
    while True:
        await socket.send_text(await queue.next())


async def _expect_nothing(socket: WebSocket) -> None:
    """Waits for the end; clients must not send anything here."""
    try:
        await socket.receive_text()
    except (WebSocketDisconnect, KeyError):
        return
    await socket.close(POLICY_VIOLATION, "nothing is taken here")
