"""Commands to a recording that is played elsewhere: where it is, pause, seek, step, rate."""

import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import RequestClient
from deltalight.services.api.render_link import UnansweredError

ASK_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class Position:
    """Position of what is played, in seconds from its first frame; `recording` None = it is the node's own source."""

    recording: str | None
    position_s: float
    duration_s: float
    playing: bool
    rate: float
    loop: bool


class PlaybackClient:
    """Asks a `deltalight replay` at its control endpoint; `last` is its last known position."""

    def __init__(self, recording: str | None, control: str, keys: Keys | None) -> None:
        self.last: Position | None = None
        self._recording = recording
        self._client = RequestClient(control, keys=keys)

    def ask(
        self, op: str, payload: Mapping[str, object] | None = None, timeout_s: float = ASK_TIMEOUT_S
    ) -> Position:
        """Executes a command and returns the position after it.

        Raises:
            UnansweredError: it does not answer.
            DeltalightError: it refuses.
        """
        request = ControlRequest(
            node="api", capture_ns=time.time_ns(), id=uuid.uuid4().hex, op=op, payload=dict(payload or {})
        )
        try:
            reply = self._client.request(request, timeout_s)
        except DeltalightError as fault:
            raise UnansweredError(f"The replay does not answer ({str(fault).rstrip('.')}).") from fault
        if reply.error is not None:
            raise DeltalightError(reply.error)
        self.last = Position(recording=self._recording, **reply.payload)  # type: ignore[arg-type]
        return self.last

    def close(self) -> None:
        """Closes the connection, without waiting for an answer."""
        self._client.abandon()
        self._client.close()
