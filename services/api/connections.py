"""HTTP connections with limits: who sends nothing, or a head in drips, takes nobody's place."""

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_TIMEOUT_S = 10.0  # from a connection's beginning, or its last response, to a whole head of a request
CONNECTIONS_PER_CLIENT = 128  # half of all: twice the streams of one client


class LimitedProtocol(H11Protocol):
    """Ends connections that have no request for some time, and those of a client that has too many.

    uvicorn answers 503 to everybody while it has its maximum of connections, and waits for ever for a first request.
    """

    _silence: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin a connection."""
        super().connection_made(transport)
        self._await_request()
        if self.client is not None and self._count_of(self.client[0]) > CONNECTIONS_PER_CLIENT:
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """End a connection."""
        super().connection_lost(exc)
        if self._silence is not None:
            self._silence.cancel()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._await_request()

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
