"""Middleware that checks every request before the application sees it.

It checks host, origin, rate, token, role and the size of the body.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, QueryParams
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deltalight.protocol.errors import DeltalightError
from deltalight.services.api.credentials import Principal, SecretToken, Tickets, principal_of, set_principal
from deltalight.services.api.host_names import HostNames
from deltalight.services.api.limits import RateLimit, StreamLimits, run_while
from deltalight.services.api.problems import ProblemError, Problems
from deltalight.services.storage.faults import OutdatedTokenError
from deltalight.services.storage.tokens import TokenStore

BODY_LIMIT_BYTES = 2 << 20  # three times a document with the maximum number of objects
UPLOAD_PATH = "/api/v1/assets"
RECORDING_UPLOAD_PATH = "/api/v1/recordings/upload"
PROTECTED = "/api/"  # the page's files and the API's description are public
OPEN_PATHS = frozenset({"/api/v1/health", "/api/v1/ready"})  # they reveal nothing that requires a token
STREAM_PATHS = frozenset({"/api/v1/live.mjpg"})  # endless responses that are no WebSockets
# POST requests without side effects.
READ_ONLY_PATHS = frozenset({"/api/v1/tickets", "/api/v1/live/pick"})
WHEP_PATH = "/api/v1/whep"  # its sessions, below it, show pictures and change nothing
ADDRESSES_OF_TOKEN = 4  # that may send as much as one may, all together
WRONG_TOKENS_PER_S, WRONG_TOKENS_AT_ONCE = 1 / 6, 10
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
POLICY_VIOLATION = 1008  # WebSocket close code


@dataclass(frozen=True)
class AuthRules:
    """Requirements of the middleware."""

    needs_token: bool
    host_names: HostNames
    requests_per_s: float
    upload_limit_bytes: int
    recording_limit_bytes: int


class AuthMiddleware:
    """Authenticates and authorises requests, and answers those that it refuses.

    There are no cookies, so a browser never sends credentials by itself. Checking Origin and Host prevents pages of
    other sites from reaching a loopback service that requires no token.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        rules: AuthRules,
        tokens: TokenStore,
        tickets: Tickets,
        problems: Problems,
        streams: StreamLimits,
        secrets: Sequence[SecretToken] = (),
    ) -> None:
        self._app = app
        self._rules = rules
        self._tokens = tokens
        self._tickets = tickets
        self._secrets = secrets
        self._problems = problems
        self._rate = RateLimit(rules.requests_per_s, 2 * rules.requests_per_s)
        of_token = ADDRESSES_OF_TOKEN * rules.requests_per_s
        self._rate_of_tokens = RateLimit(of_token, 2 * of_token)
        self._wrong_tokens = RateLimit(WRONG_TOKENS_PER_S, WRONG_TOKENS_AT_ONCE)
        self._streams = streams

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or answers it here."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        try:
            await self._admit(scope)
            if scope["type"] == "websocket" or scope["path"] in STREAM_PATHS:
                await self._stream(scope, receive, send)
                return
            limit = _BodyLimit(self._body_limit(scope), receive)
            limit.check_announced(Headers(scope=scope))
            _require_plain_body(Headers(scope=scope))
        except ProblemError as refusal:
            await self._problems.of_http(refusal)(scope, receive, send)
            return
        except DeltalightError as fault:  # the tokens cannot be read at the moment
            await self._problems.of_fault(fault)(scope, receive, send)
            return
        await self._app(scope, limit.receive, send)

    async def _admit(self, scope: Scope) -> None:
        headers = Headers(scope=scope)
        self._check_names(headers)
        _count(self._rate, _client(scope))
        principal = await self._authenticate(scope, headers)
        if known := principal.token_id or principal.name:
            _count(self._rate_of_tokens, known)  # whatever addresses it comes from
        if principal.role == "view" and not _is_read_only(scope):
            raise _read_only_role(principal)
        set_principal(scope, principal)

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes on a long-lived connection; it counts as a stream, and ends when its token is revoked."""
        token_id = principal_of(scope).token_id

        async def is_allowed() -> bool:
            return token_id is None or await run_in_threadpool(self._tokens.knows, token_id)

        with self._streams.slot(_client(scope)):
            ended_by_itself = await run_while(self._app(scope, receive, send), is_allowed)
        if not ended_by_itself and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": "token revoked"})

    def _check_names(self, headers: Headers) -> None:
        host = headers.get("host", "")
        self._rules.host_names.require(host)
        origin = headers.get("origin")
        if (origin is not None and (_host_of(origin) or " ") != host.lower()) or _is_embedded(headers):
            raise ProblemError(
                403,
                "origin",
                "Requests from other sites are refused; open the page from this service's own address.",
            )

    async def _authenticate(self, scope: Scope, headers: Headers) -> Principal:
        """Authenticates a request; a token or ticket must be valid if sent, even where none is required."""
        scheme, _, token = headers.get("authorization", "").partition(" ")
        ticket = QueryParams(scope["query_string"]).get("ticket")
        if not scheme and (ticket is None or not _takes_tickets(scope)):
            if self._rules.needs_token and _is_protected(scope):
                raise _unknown_token(False)
            return Principal("control")
        client = _client(scope)
        wait_s = self._wrong_tokens.wait_s(client)
        if wait_s > 0:
            raise _too_many(wait_s, "wrong-tokens", "Too many wrong tokens came from this address; wait.")
        if scheme:
            principal = await self._verified(scheme, token)
        else:
            principal = await run_in_threadpool(self._tickets.redeem, ticket or "")
        if principal is None:
            self._wrong_tokens.take(client)
            raise _unknown_token(True)
        return principal

    async def _verified(self, scheme: str, given: str) -> Principal | None:
        if scheme.lower() != "bearer":
            return None
        for secret in self._secrets:
            if (principal := secret.verify(given.strip())) is not None:
                return principal
        try:
            token = await run_in_threadpool(self._tokens.verify, given.strip())
        except OutdatedTokenError as fault:
            raise _unauthorized(str(fault)) from fault
        return None if token is None else Principal(token.role, token.id, token.name)

    def _body_limit(self, scope: Scope) -> int:
        uploads = {
            UPLOAD_PATH: self._rules.upload_limit_bytes,
            RECORDING_UPLOAD_PATH: self._rules.recording_limit_bytes,
        }
        return uploads.get(scope["path"], BODY_LIMIT_BYTES) if scope["method"] == "POST" else BODY_LIMIT_BYTES


class _BodyLimit:
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


def _require_plain_body(headers: Mapping[str, str]) -> None:
    coding = headers.get("content-encoding", "identity")
    if coding.strip().lower() not in ("", "identity"):
        sentence = f"The body is encoded ({coding:.20}); send it as it is, without Content-Encoding."
        raise ProblemError(415, "content-encoding", sentence, {"Accept-Encoding": "identity"})


def _takes_tickets(scope: Scope) -> bool:
    return scope["type"] == "websocket" or scope["method"] in SAFE_METHODS or _is_whep(scope)


def _is_whep(scope: Scope) -> bool:
    path: str = scope["path"]
    return path == WHEP_PATH or path.startswith(f"{WHEP_PATH}/")


def _is_read_only(scope: Scope) -> bool:
    return _takes_tickets(scope) or scope["path"] in READ_ONLY_PATHS


def _is_protected(scope: Scope) -> bool:
    return scope["path"].startswith(PROTECTED) and scope["path"] not in OPEN_PATHS


def _is_embedded(headers: Headers) -> bool:
    """Whether a page of another site embeds this; browsers send no Origin for pictures and frames."""
    return (
        headers.get("sec-fetch-site") in ("cross-site", "same-site")
        and headers.get("sec-fetch-dest") != "document"
    )


def _read_only_role(principal: Principal) -> ProblemError:
    return ProblemError(
        403,
        "role",
        f"The token `{principal.name}` is read-only; use one with role control to make changes.",
    )


def _unknown_token(was_given: bool) -> ProblemError:
    sentence = (
        "The token or ticket is unknown; make a token with `deltalight api token NAME`."
        if was_given
        else "A token is needed; send it as `Authorization: Bearer TOKEN`."
    )
    return _unauthorized(sentence)


def _unauthorized(sentence: str) -> ProblemError:
    return ProblemError(401, "token", sentence, {"WWW-Authenticate": "Bearer"})


def _count(limit: RateLimit, sender: str) -> None:
    """Counts a request of a sender.

    Raises:
        ProblemError: it has sent too many.
    """
    wait_s = limit.wait_s(sender)
    if wait_s > 0:
        raise _too_many(wait_s, "rate", "Too many requests; send fewer a second.")
    limit.take(sender)


def _too_many(wait_s: float, kind: str, sentence: str) -> ProblemError:
    return ProblemError(429, kind, sentence, {"Retry-After": str(int(wait_s) + 1)})


def _client(scope: Scope) -> str:
    return scope["client"][0] if scope.get("client") else ""


def _host_of(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""
