"""Where frames come from: the endpoints that are read now, which a command may change."""

from collections.abc import Sequence

from pydantic import Field

from protocol.documents import StrictModel
from protocol.keys import Keys
from protocol.transport import ReceivedMultipart, Receiver
from render_server.server.frames import TOPICS

MAX_ENDPOINTS = 16
EARLIER_SOURCES = "earlier_sources"


class SourceOrder(StrictModel):
    """Endpoints to read frames from; null = those that were configured."""

    endpoints: tuple[str, ...] | None = Field(min_length=1, max_length=MAX_ENDPOINTS)


class FrameSource:
    """Receives the streams of `configured` endpoints until others are named.

    `keys` are needed where an endpoint leaves the host.

    Raises:
        DeltalightError: an endpoint that leaves the host without keys, or is not understood.
    """

    def __init__(self, configured: Sequence[str], keys: Keys | None = None) -> None:
        self._configured = self._endpoints = tuple(configured)
        self._keys = keys
        self._earlier_drops = 0
        self._receiver = Receiver(self._configured, TOPICS, keys=keys)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """What is read now."""
        return self._endpoints

    def use(self, endpoints: Sequence[str] | None) -> bool:
        """Read from these from now on, None = the configured ones; returns whether they are others than before.

        If so, what waits is thrown away.

        Raises:
            DeltalightError: as above; then all stays as it was.
        """
        wanted = self._configured if endpoints is None else tuple(endpoints)
        if wanted == self._endpoints:
            return False
        receiver = Receiver(wanted, TOPICS, keys=self._keys)
        before, self._receiver, self._endpoints = self._receiver, receiver, wanted
        self._earlier_drops += sum(before.drops.values())
        before.close()
        return True

    def latest(self, timeout_s: float) -> dict[str, ReceivedMultipart] | None:
        """Newest message of every topic (`Receiver.latest`)."""
        return self._receiver.latest(timeout_s)

    @property
    def drops(self) -> dict[str, int]:
        """Messages of each topic that a newer one replaced before they were taken.

        Those of earlier sources are one number, because there is no end to their names.
        """
        earlier = {EARLIER_SOURCES: self._earlier_drops} if self._earlier_drops else {}
        return {**earlier, **self._receiver.drops}

    def close(self) -> None:
        """Stop receiving."""
        self._receiver.close()
