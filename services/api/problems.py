"""Errors as problem details (RFC 9457): one sentence each, refusals counted by kind."""

from collections import Counter
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from deltalight.protocol.documents import beyond_limits, wrong_in_words
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import as_sentence
from deltalight.services.api.render_link import UnansweredError
from deltalight.services.storage.faults import (
    ConflictError,
    NotFoundError,
    RejectedAssetError,
    StaleRevisionError,
    StorageFaultError,
    TooLargeError,
)

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:deltalight:problem:"
LOOKED_AGAIN_S = "1"  # a silent render server is asked again each second

log = structlog.get_logger()

# The first class that an error is an instance of determines its status and kind.
_KINDS: tuple[tuple[type[DeltalightError], int, str], ...] = (
    (NotFoundError, 404, "not-found"),
    (StaleRevisionError, 409, "stale-revision"),
    (ConflictError, 409, "conflict"),
    (RejectedAssetError, 422, "rejected-asset"),
    (TooLargeError, 413, "too-large"),
    (StorageFaultError, 503, "storage-fault"),
    (UnansweredError, 503, "render-server"),
    (DeltalightError, 422, "invalid"),
)


# Advice for the two-word sentences of the framework.
_ADVICE = {
    "Not Found": ": there is nothing at this address; /openapi.json lists what there is.",
    "Method Not Allowed": ": this address does not support that method; /openapi.json lists those that it does.",
}


class Problem(BaseModel):
    """What is wrong and what to do."""

    type: str = Field(description="Kind of problem, for programs.", examples=[TYPE_PREFIX + "stale-revision"])
    title: str = Field(description="The status in words.", examples=["Conflict"])
    status: int = Field(description="The HTTP status.", examples=[409])
    detail: str = Field(
        description="One sentence for the user.",
        examples=["the scene is at revision 7 and the change was made to 5; get it and change it again."],
    )
    revision: int | None = Field(default=None, description="The newest revision; only with `stale-revision`.")


class ProblemError(HTTPException):
    """A refusal by the service itself: `kind` ends the problem's type."""

    def __init__(
        self, status: int, kind: str, sentence: str, headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(status, sentence, dict(headers or {}))
        self.kind = kind


def unreadable_json(cause: BaseException | None) -> ProblemError:
    """Returns the refusal of a body that `json.loads` ended with `cause`."""
    limit = beyond_limits(cause) if isinstance(cause, ValueError | RecursionError) else None
    sentence = "The body is not valid JSON; correct it." if limit is None else f"The body {limit}."
    return ProblemError(400, "not-json", sentence)


class Problems:
    """Turns errors into responses and counts them by kind."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def response(
        self,
        status: int,
        kind: str,
        sentence: str,
        *,
        headers: Mapping[str, str] | None = None,
        revision: int | None = None,
    ) -> JSONResponse:
        """Returns a problem as a response; what a client sent may be part of `sentence`."""
        self.counts[kind] += 1
        problem = Problem(
            type=TYPE_PREFIX + kind,
            title=HTTPStatus(status).phrase,
            status=status,
            detail=as_sentence(sentence),
            revision=revision,
        )
        return JSONResponse(
            problem.model_dump(exclude_none=True), status, dict(headers or {}), media_type=MEDIA_TYPE
        )

    def of_http(self, fault: HTTPException) -> JSONResponse:
        """Returns the response to a refusal by the framework or the middleware."""
        if fault.status_code == 400 and not isinstance(fault, ProblemError):  # the body's text cannot be read
            return self._not_json(fault.__cause__)
        status = fault.status_code
        kind = fault.kind if isinstance(fault, ProblemError) else _slug(status)
        return self.response(
            status, kind, f"{fault.detail}{_ADVICE.get(fault.detail, '')}", headers=fault.headers
        )

    def of_fault(self, fault: DeltalightError) -> JSONResponse:
        """Returns the response to a refusal by the storage or a document."""
        status, kind = next((status, kind) for each, status, kind in _KINDS if isinstance(fault, each))
        revision = fault.current if isinstance(fault, StaleRevisionError) else None
        headers = {"Retry-After": LOOKED_AGAIN_S} if isinstance(fault, UnansweredError) else None
        return self.response(status, kind, str(fault), headers=headers, revision=revision)

    def install(self, app: FastAPI) -> None:
        """Registers the handlers of all errors of the application."""

        @app.exception_handler(HTTPException)
        async def _http(request: Request, fault: HTTPException) -> JSONResponse:
            if fault.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
                fault.headers = {"Allow": _allowed(request)}
            return self.of_http(fault)

        @app.exception_handler(DeltalightError)
        async def _refused(_request: Request, fault: DeltalightError) -> JSONResponse:
            return self.of_fault(fault)

        @app.exception_handler(RequestValidationError)
        async def _invalid(_request: Request, fault: RequestValidationError) -> JSONResponse:
            return self._of_request(fault)

        @app.exception_handler(ClientDisconnect)
        async def _gone(_request: Request, _fault: ClientDisconnect) -> JSONResponse:
            return self.response(
                400, "incomplete", "The connection ended before the body did; send it again."
            )

        @app.exception_handler(OSError)
        async def _disk(_request: Request, fault: OSError) -> JSONResponse:
            log.error("the data folder cannot be used", fault=str(fault))
            sentence = f"The data folder cannot be used ({fault.strerror}); free some space or check its permissions."
            return self.response(503, "storage-fault", sentence)

        @app.exception_handler(Exception)
        async def _internal(_request: Request, fault: Exception) -> JSONResponse:
            sentence = f"The service failed ({type(fault).__name__}); see its log and report it."
            return self.response(500, "internal", sentence)

    def _not_json(self, cause: BaseException | None = None) -> JSONResponse:
        return self.of_http(unreadable_json(cause))

    def _of_request(self, fault: RequestValidationError) -> JSONResponse:
        first = fault.errors()[0]
        if first["type"] == "json_invalid":
            return self._not_json()
        if first["type"] == "missing":
            sentence = (
                "The body is missing; send one, as JSON."
                if first["loc"] == ("body",)
                else f"`{_place(first['loc'])}` is missing; add it."
            )
            return self.response(422, "invalid", sentence)
        if isinstance(fault.body, bytes):  # as curl sends it without being told the type
            return self.response(
                422, "invalid", "Send the body as JSON, with Content-Type: application/json."
            )
        return self.response(422, "invalid", f"`{_place(first['loc'])}` is wrong: {wrong_in_words(first)}.")


def problem_schema() -> dict[str, Any]:
    """Returns the schema of a problem for an OpenAPI document's components, where descriptions refer to it."""
    schema = Problem.model_json_schema(mode="serialization")
    return {Problem.__name__: jsonable_encoder(schema, exclude_none=True)}


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Returns the errors of a route for its OpenAPI description."""
    return {status: _described(HTTPStatus(status).phrase) for status in statuses}


def unavailable(when: str) -> dict[int | str, dict[str, Any]]:
    """Returns the 503 of a route for its OpenAPI description; `when` is a sentence."""
    return {503: _described(when)}


def _described(what: str) -> dict[str, Any]:
    """Describes an error by a reference: FastAPI would make a validator of each `model` that is named here."""
    schema = {"$ref": f"#/components/schemas/{Problem.__name__}"}
    return {"description": what, "content": {MEDIA_TYPE: {"schema": schema}}}


def _allowed(request: Request) -> str:
    """Returns the methods of all routes at an address; the framework names those of the first."""
    routes = (
        route for route in request.app.router.routes if route.matches(request.scope)[0] is Match.PARTIAL
    )
    methods = {method for route in routes for method in route.methods}
    return ", ".join(sorted(methods | {"HEAD"} if "GET" in methods else methods))


def _slug(status: int) -> str:
    return HTTPStatus(status).phrase.lower().replace(" ", "-")


def _place(steps: tuple[int | str, ...]) -> str:
    return ".".join(map(str, steps))
