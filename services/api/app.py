"""The web application: routes, gate and problem details put together."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from starlette.middleware import Middleware

from protocol.keys import Keys
from services.api import (
    assets,
    event_socket,
    fisheye,
    lights,
    live,
    nodes,
    objects,
    parts,
    recordings,
    replay,
    scenes,
    snapshots,
    state,
)
from services.api.camera_finder import CameraFinder
from services.api.context import Context
from services.api.events import EventHub
from services.api.fisheye_view import FisheyeView
from services.api.gate import Gate, GateRules
from services.api.live_hub import LiveHub
from services.api.metrics import Meter, Metrics
from services.api.page import Page
from services.api.playback import Playback
from services.api.problems import Problems, describe_problems, responses
from services.api.process_watch import ProcessWatch
from services.api.render_link import RenderLink
from services.api.secret_token import SecretToken
from services.api.settings import ApiSettings
from services.api.snapshot_shelf import SnapshotShelf
from services.api.streams import Streams, sinks
from services.api.take_recorder import RunningTake, TakeRecorder
from services.api.take_shelf import TakeShelf
from services.api.tickets import TicketBox
from services.storage.store import Store

PREFIX = "/api/v1"
RESOURCES = (
    scenes,
    objects,
    lights,
    parts,
    assets,
    live,
    fisheye,
    nodes,
    recordings,
    replay,
    snapshots,
    state,
    event_socket,
)
ANYWHERE = (400, 401, 403, 413, 422, 429, 503)  # what the gate, a body or the disk may be refused with
DESCRIPTION = """Scenes, assets and the state of a Deltalight installation.

Every change of a scene is a revision; `If-Match` with the revision that a change is made to refuses it (409) where
somebody else was faster. Errors are problem details (RFC 9457) with one sentence in `detail`. On loopback no token is
needed; elsewhere each request carries `Authorization: Bearer TOKEN`, or its address a ticket (`?ticket=...`).

Not described here: the WebSockets `/api/v1/live` (pictures) and `/api/v1/events`, and `/api/v1/live.mjpg`."""
TAGS = [
    {
        "name": "scenes",
        "description": "Scene documents, their revisions, undo, and which of them is rendered.",
    },
    {"name": "objects", "description": "Virtual objects of a scene, with pose and material."},
    {"name": "lights", "description": "Where light comes from."},
    {"name": "method", "description": "How the real scene is relit."},
    {"name": "output", "description": "The picture that comes out."},
    {"name": "assets", "description": "Uploaded meshes and environment maps, kept under their SHA-256."},
    {
        "name": "live",
        "description": "The picture, what a place in it shows, and what the fish-eye camera sees.",
    },
    {"name": "recordings", "description": "Recordings of nodes, and the replay of one in place of them."},
    {"name": "snapshots", "description": "Pictures of one frame to keep, in any number of views."},
    {"name": "nodes", "description": "Nodes, render servers and cameras."},
    {"name": "state", "description": "How the processes are doing."},
]


class _App(FastAPI):
    """FastAPI whose OpenAPI document names the media type of problems, and tokens."""

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        if self.openapi_schema is None:
            schema = describe_problems(super().openapi())
            schema["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
            schema["security"] = [{}, {"token": []}]
            self.openapi_schema = schema
        return self.openapi_schema


def create_app(settings: ApiSettings, store: Store, keys: Keys | None = None) -> FastAPI:
    """The application; it speaks with the render server while it runs. The store stays the caller's."""
    context = _context(settings, store, keys)
    streams = Streams(settings.subscribe, sinks(context), keys)
    context.link.on_source = streams.follow

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        context.live.attach(asyncio.get_running_loop())
        context.link.start()
        streams.start()
        yield
        await run_in_threadpool(context.playback.close)
        await run_in_threadpool(context.recorder.close)
        await run_in_threadpool(streams.close)
        await run_in_threadpool(context.link.close)

    rules = GateRules(
        needs_token=settings.leaves_host,
        requests_per_s=settings.requests_per_s,
        upload_limit_bytes=settings.upload_limit_mb << 20,
    )
    app = _App(
        title="Deltalight",
        version=version("deltalight"),
        description=DESCRIPTION,
        openapi_tags=TAGS,
        docs_url=None,  # its page would load scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
        separate_input_output_schemas=False,
        generate_unique_id_function=lambda route: route.name,
        middleware=[
            Middleware(Meter, metrics=context.metrics),
            Middleware(
                Gate,
                rules=rules,
                tokens=store.tokens,
                tickets=context.tickets,
                problems=context.problems,
                secret=None if settings.token_file is None else SecretToken(settings.token_file),
            ),
        ],
    )
    app.state.context = context
    context.problems.install(app)
    for resource in RESOURCES:
        app.include_router(resource.router, prefix=PREFIX, responses=responses(*ANYWHERE))
    app.router.default = Page(app.router.not_found)
    return app


def _context(settings: ApiSettings, store: Store, keys: Keys | None) -> Context:
    events, watch, live_hub, problems = EventHub(), ProcessWatch(), LiveHub(), Problems()
    link = RenderLink(
        store, settings.control, keys, on_picture=lambda picture: events.publish("picture", asdict(picture))
    )
    takes = TakeShelf(store.folder / "recordings")

    def tell_take(take: RunningTake, is_growing: bool) -> None:
        events.publish("recording", recordings.recording_event(takes, take, is_growing=is_growing))

    playback = Playback(
        link,
        settings.control,
        publish=lambda position: events.publish("replay", replay.replay_answer(position).model_dump()),
        notice=lambda text: events.publish("notice", {"text": text}),
        keys=keys,
    )
    return Context(
        store=store,
        link=link,
        events=events,
        live=live_hub,
        fisheye=FisheyeView(),
        watch=watch,
        cameras=CameraFinder(),
        tickets=TicketBox(),
        takes=takes,
        recorder=TakeRecorder(takes, settings.subscribe, tell_take),
        playback=playback,
        snapshots=SnapshotShelf(store.folder / "snapshots"),
        settings=settings,
        problems=problems,
        metrics=Metrics(problems, watch, link, live_hub, events),
    )
