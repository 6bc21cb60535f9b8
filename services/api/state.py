"""Routes that tell how the service and the processes around it are doing."""

from importlib.metadata import version
from typing import Literal

from fastapi import APIRouter, Response
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel, Field

from services.api.context import Shared
from services.api.metrics import MEDIA_TYPE
from services.api.models import PictureState, ProcessAnswer
from services.api.problems import responses

router = APIRouter(tags=["state"])


class StreamState(BaseModel):
    """Whether pictures come."""

    status: Literal["waiting", "ok", "stale"] = Field(
        description="`waiting` = none came yet; `stale` = none for two seconds."
    )
    frame_id: int | None = Field(description="Of the newest.")
    last_frame_s: float | None = Field(description="Seconds since it came.")
    frames_per_s: float | None


class Health(BaseModel):
    """Whether the service works; it needs no token."""

    status: Literal["ok", "degraded"] = Field(description="`degraded` = the render server does not answer.")
    render_server: Literal["answers", "silent"]
    stream: StreamState
    version: str


class State(BaseModel):
    """How the render server and the nodes are doing."""

    render_server: Literal["answers", "silent"]
    picture: PictureState | None = Field(description="What became of the active scene's newest revision.")
    processes: list[ProcessAnswer] = Field(description="Nodes and render server, as they report each second.")
    refused: dict[str, int] = Field(description="Requests refused since the start, by kind of problem.")


class Settings(BaseModel):
    """What a client needs to know of the service's settings."""

    version: str
    needs_token: bool
    upload_limit_bytes: int
    requests_per_s: float


@router.get("/health", responses=responses(503))
def health(shared: Shared) -> Health:
    """Whether the service works and reads its storage."""
    shared.store.scenes.all()
    return Health(
        status="ok" if shared.link.is_reachable else "degraded",
        render_server=_server(shared),
        stream=_stream(shared),
        version=version("deltalight"),
    )


@router.get("/state")
def state(shared: Shared) -> State:
    """Rates, drops, delays and remarks of the processes."""
    picture = shared.link.picture
    return State(
        render_server=_server(shared),
        picture=None if picture is None else PictureState.of(picture),
        processes=[ProcessAnswer.of(report) for report in shared.watch.reports()],
        refused=dict(shared.problems.counts),
    )


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(shared: Shared) -> Response:
    """Measurements for Prometheus."""
    return Response(shared.metrics.text(), media_type=MEDIA_TYPE)


@router.get("/settings")
def settings(shared: Shared) -> Settings:
    """Limits of this service."""
    return Settings(
        version=version("deltalight"),
        needs_token=shared.settings.leaves_host,
        upload_limit_bytes=shared.settings.upload_limit_mb << 20,
        requests_per_s=shared.settings.requests_per_s,
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
