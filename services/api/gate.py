"""What every request passes before the application: host, origin, rate, token, role, size of the body."""

from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api.problems import ProblemError, Problems
from services.api.rate import RateLimit
from services.ports import LOOPBACK
from services.storage.tokens import Token, TokenStore

BODY_LIMIT_BYTES = 2 << 20  # three times a document with the most objects that one may have
UPLOAD_PATH = "/api/v1/assets"
OPEN_PATHS = frozenset({"/api/v1/health", "/openapi.json"})  # they tell nothing that needs a token
WRONG_TOKENS_PER_S, WRONG_TOKENS_AT_ONCE = 1 / 6, 10
LOOPBACK_NAMES = frozenset({LOOPBACK, "localhost", "::1"})
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
POLICY_VIOLATION = 1008  # WebSocket close code


@dataclass(frozen=True)
class GateRules:
    """`needs_token` = other hosts can connect; without it the Host header must be loopback's."""

    needs_token: bool
    requests_per_s: float
    upload_limit_bytes: int


class Gate:
    """Middleware that lets through what may pass.

    There are no cookies, so a browser sends no rights by itself; that a page of another site may reach a service on
    loopback which needs no token is stopped by Origin and Host.
    """

    def __init__(self, app: ASGIApp, rules: GateRules, tokens: TokenStore, problems: Problems) -> None:
        self._app = app
        self._rules = rules
        self._tokens = tokens
        self._problems = problems
        self._rate = RateLimit(rules.requests_per_s, 2 * rules.requests_per_s)
        self._wrong_tokens = RateLimit(WRONG_TOKENS_PER_S, WRONG_TOKENS_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it here."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] != "http":
            await send({"type": "websocket.close", "code": POLICY_VIOLATION})
        else:
            await self._pass(scope, receive, send)

    async def _pass(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        try:
            self._check_names(headers)
            self._check_rate(scope)
            await self._check_token(scope, headers)
            limit = _Limit(self._body_limit(scope), receive)
            limit.check_announced(headers)
        except ProblemError as refusal:
            await self._problems.of_http(refusal)(scope, receive, send)
            return
        await self._app(scope, limit.receive, send)

    def _check_names(self, headers: Headers) -> None:
        host = headers.get("host", "")
        if not self._rules.needs_token and _host_name(host) not in LOOPBACK_NAMES:
            raise ProblemError(
                400, "host", "This service is on loopback; address it as 127.0.0.1 or localhost."
            )
        origin = headers.get("origin")
        if origin is not None and (_host_of(origin) or " ") != host.lower():
            raise ProblemError(
                403,
                "origin",
                "Pages of other sites are refused; open the page from this service's own address.",
            )

    def _check_rate(self, scope: Scope) -> None:
        client = _client(scope)
        wait_s = self._rate.wait_s(client)
        if wait_s > 0:
            raise _too_many(wait_s, "rate", "Too many requests; send fewer a second.")
        self._rate.take(client)

    async def _check_token(self, scope: Scope, headers: Headers) -> None:
        """A token that is sent must be right, even where none is needed."""
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if not scheme and (not self._rules.needs_token or scope["path"] in OPEN_PATHS):
            return
        client = _client(scope)
        wait_s = self._wrong_tokens.wait_s(client)
        if wait_s > 0:
            raise _too_many(wait_s, "wrong-tokens", "Too many wrong tokens came from this address; wait.")
        token = (
            await run_in_threadpool(self._tokens.verify, given.strip())
            if scheme.lower() == "bearer"
            else None
        )
        if token is None:
            if scheme:
                self._wrong_tokens.take(client)
            raise _unknown_token(bool(scheme))
        _check_role(token, scope)

    def _body_limit(self, scope: Scope) -> int:
        is_upload = scope["path"] == UPLOAD_PATH and scope["method"] == "POST"
        return self._rules.upload_limit_bytes if is_upload else BODY_LIMIT_BYTES


class _Limit:
    """Counts the bytes of a body as they arrive."""

    def __init__(self, limit_bytes: int, receive: Receive) -> None:
        self._limit_bytes = limit_bytes
        self._receive = receive
        self._received_bytes = 0

    def check_announced(self, headers: Mapping[str, str]) -> None:
        announced = headers.get("content-length", "0")
        if announced.isdecimal() and int(announced) > self._limit_bytes:
            raise self._refusal()

    async def receive(self) -> Message:
        message = await self._receive()
        self._received_bytes += len(message.get("body", b""))
        if self._received_bytes > self._limit_bytes:
            raise self._refusal()
        return message

    def _refusal(self) -> ProblemError:
        sentence = f"The body is larger than {self._limit_bytes >> 20} MB; send less."
        return ProblemError(413, "too-large", sentence, {"Connection": "close"})


def _check_role(token: Token, scope: Scope) -> None:
    if token.role == "view" and scope["method"] not in SAFE_METHODS:
        raise ProblemError(
            403,
            "role",
            f"The token `{token.name}` may only look; use one of role control to change something.",
        )


def _unknown_token(was_given: bool) -> ProblemError:
    sentence = (
        "The token is not known; make one with `deltalight api token NAME`."
        if was_given
        else "A token is needed; send it as `Authorization: Bearer TOKEN`."
    )
    return ProblemError(401, "token", sentence, {"WWW-Authenticate": "Bearer"})


def _too_many(wait_s: float, kind: str, sentence: str) -> ProblemError:
    return ProblemError(429, kind, sentence, {"Retry-After": str(int(wait_s) + 1)})


def _client(scope: Scope) -> str:
    return scope["client"][0] if scope.get("client") else ""


def _host_of(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _host_name(host: str) -> str | None:
    """The name in a Host header, without its port."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
