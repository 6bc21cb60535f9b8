"""Where the routes of the REST API stand, and what all of them may answer."""

from collections.abc import Sequence
from typing import Any

from fastapi import APIRouter

from deltalight.services.api.problems import responses

PREFIX = "/api/v1"
ANYWHERE = (400, 401, 403, 413, 422, 429, 503)  # raised by the middleware, by a body, or by the disk


def api_router(path: str = "", *, tags: Sequence[str] = (), dependencies: Sequence[Any] = ()) -> APIRouter:
    """Returns a router of routes below `path` whose tags and dependencies are these.

    Its routes are whole: an application takes them as they are, and `include_router` would describe each anew, twice.
    """
    return APIRouter(
        prefix=PREFIX + path,
        tags=list(tags),
        dependencies=dependencies,
        responses=responses(*ANYWHERE),
        generate_unique_id_function=lambda route: route.name,
    )
