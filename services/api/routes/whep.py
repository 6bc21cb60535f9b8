"""Routes of WHEP: the live picture by WebRTC, for players that speak it (draft-ietf-wish-whep)."""

from typing import Annotated, Any

from fastapi import Path, Request, Response

from deltalight.protocol.errors import DeltalightError
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Shared
from deltalight.services.api.credentials import principal_of
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.api.routes.live import WantedCamera, WantedView
from deltalight.services.api.whep import WatchedView, Watcher

router = api_router(tags=["live"])
ROUTERS = (router,)

SDP_TYPE = "application/sdp"
LARGEST_OFFER_BYTES = 1 << 16
SDP_BODY: dict[str, Any] = {
    "requestBody": {"required": True, "content": {SDP_TYPE: {"schema": {"type": "string"}}}}
}
SDP_ANSWER: dict[int | str, dict[str, Any]] = {
    201: {
        "description": "The answer, with all candidates; `Location` is the session's address.",
        "content": {SDP_TYPE: {"schema": {"type": "string"}}},
        "headers": {"Location": {"schema": {"type": "string"}}},
    }
}
SessionId = Annotated[str, Path(pattern="^[A-Za-z0-9_-]{1,64}$", description="From `Location`.")]


@router.post(
    "/whep",
    status_code=201,
    response_class=Response,
    openapi_extra=SDP_BODY,
    responses={**responses(404, 415), **unavailable("WHEP is not available (extra `whep`)."), **SDP_ANSWER},
)
async def open_whep(
    shared: Shared, request: Request, view: WantedView = None, camera: WantedCamera = None
) -> Response:
    """Watch the live picture by WebRTC (WHEP): the body is an SDP offer, the response its answer.

    Pictures come as H.264, without sound. A ticket lets in here too.
    """
    shared.live.require(camera)
    client = request.client.host if request.client else ""
    watcher = Watcher(client, principal_of(request.scope).token_id)
    try:
        watched = WatchedView(view, camera)
        session_id, answer = await shared.whep.open(shared.live, watched, await _offer(request), watcher)
    except DeltalightError as fault:
        raise ProblemError(400, "sdp", str(fault)) from fault
    headers = {"Location": f"{request.app.url_path_for('open_whep')}/{session_id}"}
    return Response(answer, 201, headers, media_type=SDP_TYPE)


@router.options("/whep", status_code=204, include_in_schema=False)
async def describe_whep() -> Response:
    """Say which methods this route accepts."""
    return Response(status_code=204, headers={"Allow": "OPTIONS, POST", "Accept-Post": SDP_TYPE})


@router.delete("/whep/{session_id}", response_class=Response, responses=responses(404))
async def end_whep(shared: Shared, session_id: SessionId) -> Response:
    """End a WHEP session."""
    await shared.whep.end(session_id)
    return Response()


async def _offer(request: Request) -> str:
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != SDP_TYPE:
        raise ProblemError(415, "media-type", f"Send an SDP offer, with Content-Type: {SDP_TYPE}.")
    body = await request.body()
    if len(body) > LARGEST_OFFER_BYTES:
        raise ProblemError(400, "sdp", f"The offer is larger than {LARGEST_OFFER_BYTES >> 10} kB; send less.")
    try:
        return body.decode("utf-8")
    except UnicodeDecodeError as fault:
        raise ProblemError(400, "not-text", "The body is not UTF-8 text; send an SDP offer.") from fault
