"""Routes that report on the service, the processes around it, and the cameras of this host."""

from typing import Literal

from fastapi import Response
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel, Field

from deltalight import __version__
from deltalight.protocol.messages import CameraEntry, CameraStatus
from deltalight.services.api.api_router import api_router
from deltalight.services.api.camera_finder import CamerasAnswer
from deltalight.services.api.context import Shared, in_pool
from deltalight.services.api.live_frame import LiveFrame
from deltalight.services.api.live_hub import LiveHub
from deltalight.services.api.live_video import LiveCodec
from deltalight.services.api.metrics import MEDIA_TYPE
from deltalight.services.api.models import PictureState, ProcessAnswer
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.api.routes.rooms import AllRooms
from deltalight.services.api.streams import Report

READY_PICTURE_S = 10.0  # five pictures of a slow renderer

state_router = api_router(tags=["state"])
nodes_router = api_router(tags=["nodes"])
ROUTERS = (state_router, nodes_router)


class StreamState(BaseModel):
    """Whether pictures arrive."""

    status: Literal["waiting", "ok", "stale"] = Field(
        description="`waiting` = no picture yet; `stale` = none for two seconds."
    )
    frame_id: int | None = Field(description="Of the newest.")
    last_frame_s: float | None = Field(description="Seconds since it arrived.")
    frames_per_s: float | None


class Health(BaseModel):
    """Whether the service works; it needs no token."""

    status: Literal["ok", "degraded"] = Field(description="`degraded` = the render server does not respond.")
    render_server: Literal["answers", "silent"]
    stream: StreamState
    version: str


class CameraState(BaseModel):
    """A camera whose frames the render server renders, and its newest picture."""

    name: str = Field(description="Its node's.")
    status: CameraStatus = Field(
        description="`live`, or why the camera is left out: it is `silent`, sees a different board from the first "
        "camera (`other_board`), or its frames are from a different time (`other_time`)."
    )
    frame_id: int | None = Field(description="Number of its newest frame.")
    last_frame_s: float | None = Field(description="Seconds since its newest picture arrived.")
    frames_per_s: float | None


class State(BaseModel):
    """State of the render server and the nodes."""

    render_server: Literal["answers", "silent"]
    picture: PictureState | None = Field(description="State of the active scene's newest revision.")
    cameras: list[CameraState] = Field(
        description="The room's cameras, in the order of their first frames; their names are values for `camera` "
        "in other routes."
    )
    has_fisheye: bool = Field(description="Whether a fish-eye camera is sending light.")
    processes: list[ProcessAnswer] = Field(description="Reports of nodes and render server, one per second.")
    refused: dict[str, int] = Field(description="Requests refused since the start, by kind of problem.")


class Settings(BaseModel):
    """Settings of the service that a client needs to know."""

    version: str
    needs_token: bool
    upload_limit_bytes: int
    requests_per_s: float
    has_poster: bool = Field(
        description="Whether `/poster.jpg` is available as a placeholder until the first live picture."
    )
    has_poster_before: bool = Field(
        description="Whether `/poster-before.jpg` has the camera's picture of the same frame."
    )
    live_codecs: list[LiveCodec] = Field(description="Codecs that `WS /live` offers.")
    no_h264: str | None = Field(description="Why `h264` is not offered; null if it is.")
    no_whep: str | None = Field(description="Why `POST /whep` is not available; null if it is.")


class NodeAnswer(ProcessAnswer):
    """A node or render server, with its clock and its delays."""

    kind: Literal["node", "render_server"]
    clock_offset_ms: float = Field(description="Offset from its clock to the render server's.")
    delays_ms: dict[str, float] = Field(
        description="`report`: delay of its newest report. For a render server also the delays of the newest "
        "picture: `capture_to_server`, `rendering` (including waiting), `server_to_api`."
    )


@state_router.get("/health", responses=responses(503))
def health(shared: Shared) -> Health:
    """Whether the service works and reads its storage."""
    shared.store.scenes.all()
    return Health(
        status="ok" if shared.link.is_reachable else "degraded",
        render_server=_server(shared),
        stream=_stream(shared),
        version=__version__,
    )


@state_router.get("/ready", responses=unavailable("The storage, the render server or a picture is missing."))
def ready(shared: Shared, rooms: AllRooms) -> Health:
    """Whether storage, render server and a recent picture are available: for load balancers.

    With a directory of rooms: whether storage and directory are, because rooms may wait.
    """
    parts = [("the storage does not answer", not shared.store.answers())]
    if rooms.follower is not None:
        parts.append(("the directory of rooms does not answer", not rooms.follower.is_answered))
    else:
        _, since_s = shared.live.state()
        is_old = since_s is None or since_s > READY_PICTURE_S
        parts.append(("the render server does not answer", not shared.link.is_reachable))
        parts.append((f"no picture came within {READY_PICTURE_S:.0f} s", is_old))
    missing = [each for each, is_missing in parts if is_missing]
    if missing:
        raise ProblemError(503, "not-ready", f"Not ready: {'; '.join(missing)}.")
    return health(shared)


@state_router.get("/state")
def state(shared: Shared) -> State:
    """State, rates, drops and delays of the processes."""
    delivery = shared.link.newest_delivery
    return State(
        render_server=_server(shared),
        picture=None if delivery is None else PictureState.of(delivery),
        cameras=[_camera(shared.live, each) for each in shared.live.cameras],
        has_fisheye=shared.fisheye.newest is not None,
        processes=[ProcessAnswer.of(report) for report in shared.watch.reports()],
        refused=dict(shared.problems.counts),
    )


@state_router.get("/metrics", response_class=PlainTextResponse)
def metrics(shared: Shared, rooms: AllRooms) -> Response:
    """Metrics for Prometheus: those of a room, and those that all rooms share."""
    return Response(shared.metrics.text() + rooms.metrics.text(), media_type=MEDIA_TYPE)


@state_router.get("/settings")
def settings(shared: Shared) -> Settings:
    """Limits of this service."""
    return Settings(
        version=__version__,
        needs_token=shared.settings.leaves_host,
        upload_limit_bytes=shared.settings.upload_limit_mb << 20,
        requests_per_s=shared.settings.requests_per_s,
        has_poster=shared.store.poster.is_file(),
        has_poster_before=shared.store.poster_before.is_file(),
        live_codecs=["jpeg", "h264"] if shared.live.video.why_not is None else ["jpeg"],
        no_h264=shared.live.video.why_not,
        no_whep=shared.whep.why_not,
    )


@nodes_router.get("/nodes")
def list_nodes(shared: Shared) -> list[NodeAnswer]:
    """List the nodes and render servers that report: state, rates, losses, clock, delays."""
    frame = shared.live.newest
    server = shared.server_name if frame is None else shared.live.server_of(frame.message)
    return [_node(report, frame, server) for report in shared.watch.reports()]


@nodes_router.get("/cameras", responses=responses(503))
@in_pool("cameras")
def list_cameras(shared: Shared) -> CamerasAnswer:
    """List the cameras attached to this host, and why others were not found."""
    return shared.cameras.find()


def _camera(hub: LiveHub, camera: CameraEntry) -> CameraState:
    frame = hub.newest_of(camera.node)
    _, since_s = hub.state(camera.node)
    return CameraState(
        name=camera.node,
        status=camera.status,
        frame_id=None if frame is None else frame.message.frame_id,
        last_frame_s=None if since_s is None else round(since_s, 3),
        frames_per_s=hub.frames_per_s(camera.node),
    )


def _stream(shared: Shared) -> StreamState:
    status, since_s = shared.live.state()
    frame = shared.live.newest
    return StreamState(
        status=status,
        frame_id=None if frame is None else frame.message.frame_id,
        last_frame_s=None if since_s is None else round(since_s, 3),
        frames_per_s=shared.live.frames_per_s(),
    )


def _server(shared: Shared) -> Literal["answers", "silent"]:
    return "answers" if shared.link.is_reachable else "silent"


def _node(report: Report, frame: LiveFrame | None, server: str) -> NodeAnswer:
    message = report.message
    renders = message.node == server
    delays_ms = {"report": report.delay_ms, **(_picture_delays_ms(frame) if frame and renders else {})}
    return NodeAnswer(
        **ProcessAnswer.of(report).model_dump(),
        kind="render_server" if renders else "node",
        clock_offset_ms=message.clock_offset_ns / 1e6,
        delays_ms={name: round(value, 3) for name, value in delays_ms.items()},
    )


def _picture_delays_ms(frame: LiveFrame) -> dict[str, float]:
    message = frame.message
    return {
        "capture_to_server": (message.received_ns - message.capture_ns - message.clock_offset_ns) / 1e6,
        "rendering": (message.rendered_ns - message.received_ns) / 1e6,
        "server_to_api": (frame.arrived_ns - message.rendered_ns) / 1e6,
    }
