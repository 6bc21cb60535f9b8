"""The web application: assembles routes, middleware and problem details."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from pydantic.json_schema import models_json_schema
from starlette.middleware import Middleware

from deltalight import __version__
from deltalight.protocol.keys import Keys
from deltalight.services.api.auth import AuthMiddleware, AuthRules
from deltalight.services.api.context import Context
from deltalight.services.api.credentials import SecretToken
from deltalight.services.api.head_requests import HeadRequests
from deltalight.services.api.host_names import HostNames
from deltalight.services.api.metrics import MetricsMiddleware
from deltalight.services.api.problems import problem_schema
from deltalight.services.api.room_paths import RoomPaths
from deltalight.services.api.rooms import Rooms
from deltalight.services.api.routes import (
    assets,
    live,
    recording_videos,
    recordings,
    room,
    rooms,
    scenes,
    shelf,
    snapshots,
    state,
    whep,
)
from deltalight.services.api.settings import ApiSettings
from deltalight.services.api.static_page import StaticPage
from deltalight.services.live_message import LiveHeader
from deltalight.services.storage.store import Store
from deltalight.services.storage.tokens import Role

ROUTERS = (
    *scenes.ROUTERS,
    *assets.ROUTERS,
    *room.ROUTERS,
    *shelf.ROUTERS,
    *live.ROUTERS,
    *whep.ROUTERS,
    *recordings.ROUTERS,
    *recording_videos.ROUTERS,
    *snapshots.ROUTERS,
    *rooms.ROUTERS,
    *state.ROUTERS,
)
DESCRIPTION = """Scenes, assets and the state of a Deltalight installation.

Every change of a scene is a revision; `If-Match` with the revision that a change is made to refuses it (409) where
somebody else was faster. Errors are problem details (RFC 9457) with one sentence in `detail`; 503 with `Retry-After`
says that too many requests wait for the same thing. On loopback no token is needed; elsewhere each request carries
`Authorization: Bearer TOKEN`, or its address a ticket (`?ticket=...`).

Not described here: the WebSockets `/api/v1/live` (pictures) and `/api/v1/events`, and `/api/v1/live.mjpg`."""
TAGS = [
    {
        "name": "scenes",
        "description": "Scene documents, their revisions, undo, and the active scene.",
    },
    {"name": "objects", "description": "Virtual objects in a scene, with pose and material."},
    {"name": "lights", "description": "Where light comes from."},
    {"name": "method", "description": "The relighting method."},
    {"name": "output", "description": "The output picture."},
    {
        "name": "assets",
        "description": "Uploaded meshes, environment maps and precomputed materials, kept under their SHA-256.",
    },
    {
        "name": "live",
        "description": "The live picture, picking in it, and the fish-eye camera's picture.",
    },
    {"name": "recordings", "description": "Recordings of nodes, and their replay."},
    {"name": "snapshots", "description": "Stored pictures of one frame, in any number of views."},
    {"name": "nodes", "description": "Nodes, render servers and cameras."},
    {
        "name": "rooms",
        "description": "Rooms that run at once. Every route in this description also exists as `/rooms/NAME/...`, "
        "for the room NAME; without it, a route applies to the first room.",
    },
    {"name": "state", "description": "State of the processes."},
]


class _App(FastAPI):
    """FastAPI with additions to its OpenAPI document: problems, tokens, and the live header."""

    def openapi(self) -> dict[str, Any]:
        """Returns the OpenAPI document."""
        if self.openapi_schema is None:
            schema = super().openapi()
            schemas = schema["components"]["schemas"] | problem_schema()
            schema["components"]["schemas"] = dict(sorted(schemas.items())) | _live_header_schemas()
            schema["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
            schema["security"] = [{}, {"token": []}]
            self.openapi_schema = schema
        return self.openapi_schema


def _live_header_schemas() -> dict[str, Any]:
    """Returns the schemas of a live picture's header, which no HTTP route returns."""
    template = "#/components/schemas/{model}"
    _, schema = models_json_schema([(LiveHeader, "serialization")], ref_template=template)
    definitions: dict[str, Any] = schema["$defs"]
    return definitions


def create_app(settings: ApiSettings, store: Store, keys: Keys | None = None) -> FastAPI:
    """Creates the application, which talks to the render server while it runs. The caller closes the store."""
    all_rooms = Rooms(settings, store, keys)
    contexts = all_rooms.contexts
    context = next(iter(contexts.values()))

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        for each in contexts.values():
            each.live.attach(asyncio.get_running_loop())
        all_rooms.start()
        yield
        await context.whep.close()
        await run_in_threadpool(all_rooms.close)

    app = _App(
        title="Deltalight",
        version=__version__,
        description=DESCRIPTION,
        openapi_tags=TAGS,
        docs_url=None,  # FastAPI's page would load scripts from other hosts; the dashboard's build has one at /docs
        redoc_url=None,
        lifespan=lifespan,
        separate_input_output_schemas=False,
        middleware=_middleware(settings, store, context),
    )
    app.state.context, app.state.contexts, app.state.rooms = context, contexts, all_rooms
    context.problems.install(app)
    app.router.routes.extend(route for router in ROUTERS for route in router.routes)
    app.router.default = StaticPage(app.router.not_found)
    return app


def _middleware(settings: ApiSettings, store: Store, context: Context) -> list[Middleware]:
    """Returns what every request passes through, outermost first."""
    rules = AuthRules(
        needs_token=settings.leaves_host,
        host_names=HostNames(on_loopback=not settings.leaves_host, allowed=settings.allowed_hosts),
        requests_per_s=settings.requests_per_s,
        upload_limit_bytes=settings.upload_limit_mb << 20,
        recording_limit_bytes=settings.recording_limit_mb << 20,
    )
    auth = Middleware(
        AuthMiddleware,
        rules=rules,
        tokens=store.tokens,
        tickets=context.tickets,
        problems=context.problems,
        streams=context.streams,
        secrets=_secret_tokens(settings),
    )
    measuring = Middleware(MetricsMiddleware, metrics=context.metrics)
    return [Middleware(RoomPaths), Middleware(HeadRequests), measuring, auth]


def _secret_tokens(settings: ApiSettings) -> list[SecretToken]:
    """Reads the tokens of files; one that may change things first."""
    files: tuple[tuple[Path | None, Role], ...] = (
        (settings.token_file, "control"),
        (settings.view_token_file, "view"),
    )
    return [SecretToken(path, role) for path, role in files if path is not None]
