"""The web application: routes, gate and problem details put together."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from starlette.middleware import Middleware

from protocol.keys import Keys
from services.api import assets, objects, parts, scenes, state
from services.api.context import Context
from services.api.gate import Gate, GateRules
from services.api.metrics import Meter, Metrics
from services.api.problems import Problems, describe_problems, responses
from services.api.process_watch import ProcessWatch
from services.api.render_link import RenderLink
from services.api.settings import ApiSettings
from services.storage.store import Store

PREFIX = "/api/v1"
DESCRIPTION = """Scenes, assets and the state of a Deltalight installation.

Every change of a scene is a revision; `If-Match` with the revision that a change is made to refuses it (409) where
somebody else was faster. Errors are problem details (RFC 9457) with one sentence in `detail`. On loopback no token is
needed; elsewhere each request carries `Authorization: Bearer TOKEN`."""
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
    problems = Problems()
    link = RenderLink(store, settings.control, keys)
    watch = ProcessWatch(settings.subscribe, keys)
    metrics = Metrics(problems, watch, link)
    context = Context(store, link, watch, settings, problems, metrics)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        link.start()
        watch.start()
        yield
        await run_in_threadpool(watch.close)
        await run_in_threadpool(link.close)

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
            Middleware(Meter, metrics=metrics),
            Middleware(Gate, rules=rules, tokens=store.tokens, problems=problems),
        ],
    )
    app.state.context = context
    problems.install(app)
    for resource in (scenes, objects, parts, assets, state):
        app.include_router(resource.router, prefix=PREFIX, responses=responses(401, 403, 422, 429))
    return app
