"""HTTP connections with limits: who sends nothing or in drips, or takes no answer, takes nobody's place."""

import asyncio
import logging
import time
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_TIMEOUT_S = 10.0  # from a connection's beginning, or its last response, to a whole head of a request
CONNECTIONS_PER_CLIENT = 128  # half of all: twice the streams of one client
STALL_TIMEOUT_S = 60.0  # in which somebody has to take something of an answer
BODY_WINDOW_S, LEAST_BODY_BYTES = 30.0, 30_000  # of a body, in each window: 1 kB/s
LOG_INTERVAL_S = 10.0
REFUSED_SOCKET = "ASGI callable returned without completing handshake."  # that is how a refusal ends


class LimitedProtocol(H11Protocol):
    """Ends connections that have no request for some time, or stall, and those of a client that has too many.

    uvicorn answers 503 to everybody while it has its maximum of connections, and waits for ever for a first request.
    """

    _silence: asyncio.TimerHandle | None = None
    _stall: asyncio.TimerHandle | None = None
    _body_check: asyncio.TimerHandle | None = None
    _received_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begins a connection."""
        super().connection_made(transport)
        self._await_request()
        self._await_body()
        if self.client is not None and self._count_of(self.client[0]) > CONNECTIONS_PER_CLIENT:
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends a connection."""
        super().connection_lost(exc)
        self._end_timers()

    def data_received(self, data: bytes) -> None:
        """Takes what came."""
        self._received_bytes += len(data)
        super().data_received(data)

    def pause_writing(self) -> None:
        """Waits until the client takes what was sent."""
        super().pause_writing()
        self._stall = self.loop.call_later(STALL_TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Goes on to send."""
        super().resume_writing()
        if self._stall is not None:
            self._stall.cancel()

    def on_response_complete(self) -> None:
        """Waits for the next request."""
        super().on_response_complete()
        self._await_request()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hands the connection to a WebSocket's protocol; a timer would keep this one, 7 kB, for half a minute."""
        self._end_timers()
        super().handle_websocket_upgrade(event)

    def _end_timers(self) -> None:
        for timer in (self._silence, self._stall, self._body_check):
            if timer is not None:
                timer.cancel()

    def _count_of(self, host: str) -> int:
        clients: list[Any] = [getattr(connection, "client", None) for connection in self.connections]
        return sum(client is not None and client[0] == host for client in clients)

    def _await_request(self) -> None:
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self.loop.call_later(HEAD_TIMEOUT_S, self._end_if_silent)

    def _end_if_silent(self) -> None:
        has_request = self.cycle is not None and not self.cycle.response_complete
        if self in self.connections and not has_request:  # a WebSocket's protocol is another one
            self.transport.close()

    def _await_body(self) -> None:
        self._received_bytes = 0
        self._body_check = self.loop.call_later(BODY_WINDOW_S, self._end_if_dripping)

    def _end_if_dripping(self) -> None:
        cycle = self.cycle
        wants_body = cycle is not None and cycle.more_body and not cycle.response_complete
        is_read = not self.flow.read_paused and not (
            wants_body and cycle.body
        )  # else it waits for the service
        if self in self.connections and wants_body and is_read and self._received_bytes < LEAST_BODY_BYTES:
            self.transport.close()
        elif not self.transport.is_closing():
            self._await_body()


class RateLimitedLog(logging.Filter):
    """Lets each sentence of the web server through once in a while: strangers cause them as often as they like.

    That a WebSocket was refused is none: refusals are answered, and counted by their kind.
    """

    def __init__(self) -> None:
        super().__init__()
        self._due_s: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns whether a record is to be written."""
        now_s = time.monotonic()
        if record.msg == REFUSED_SOCKET or now_s < self._due_s.get(str(record.msg), now_s):
            return False
        self._due_s[str(record.msg)] = now_s + LOG_INTERVAL_S  # before its arguments are put in: some dozens
        return True
