"""Delivery of changes of the active scene to the render server, for the requests that wait for it."""

import threading
from collections.abc import Collection
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from typing import Literal

# Several pictures of a software renderer (1 to 2 a second), and less than the 5 s after which common HTTP clients
# time out.
WAIT_S = 4.0
WAITERS = 8  # of the 40 threads that handle requests

SILENT = "The render server does not answer; the scene is shown as soon as it does."
BUSY = "The render server is still busy; the event `picture` says when it has applied this."


@dataclass(frozen=True)
class Change:
    """A revision of a scene."""

    scene_id: str
    revision: int


@dataclass(frozen=True)
class DeliveryStatus:
    """The status of a revision.

    `shown`: from the next frame on; `pending`: the server has not taken it yet; `refused`: the server cannot render
    it and still shows the previous one; `superseded`: a newer one was stored before the server took this one.
    """

    state: Literal["shown", "pending", "refused", "superseded"]
    scene_id: str
    revision: int
    detail: str = ""

    @property
    def change(self) -> Change:
        """The change that this is the status of."""
        return Change(self.scene_id, self.revision)


class Deliveries:
    """Resolves the delivery of each change: the newest one when it was sent, older ones at once (any thread)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: DeliveryStatus | None = None
        self._awaited: dict[Change, Future[DeliveryStatus]] = {}
        self._waiters = threading.BoundedSemaphore(WAITERS)

    @property
    def newest(self) -> DeliveryStatus | None:
        """The status of the last change that was sent."""
        return self._newest

    @property
    def awaited(self) -> Collection[Change]:
        """Changes whose status is unknown yet."""
        with self._lock:
            return tuple(self._awaited)

    def expect(self, change: Change) -> Future[DeliveryStatus]:
        """Returns the future status of a stored change; older changes of its scene are superseded."""
        with self._lock:
            of_scene = [each for each in self._awaited if each.scene_id == change.scene_id]
            newer = max((each.revision for each in of_scene), default=0)
            if self._newest is not None and self._newest.scene_id == change.scene_id:
                newer = max(newer, self._newest.revision)
            if newer > change.revision:
                return _known(_superseded(change))
            for older in of_scene:
                if older != change:
                    self._awaited.pop(older).set_result(_superseded(older))
            return self._awaited.setdefault(change, Future())

    def wait(self, change: Change, outcome: Future[DeliveryStatus]) -> DeliveryStatus:
        """Returns the status of a change; `pending` if it takes long, or too many requests wait already."""
        if outcome.done():
            return outcome.result()
        if not self._waiters.acquire(blocking=False):
            return pending(change, BUSY)
        try:
            return outcome.result(WAIT_S)
        except FutureTimeoutError:
            return pending(change, BUSY)
        finally:
            self._waiters.release()

    def note(self, status: DeliveryStatus, awaited: Collection[Change]) -> None:
        """Resolves the change that was sent; supersedes the `awaited` ones stored before the newest was read."""
        with self._lock:
            self._newest = status
            self._resolve(status.change, status)
            for change in awaited:
                self._resolve(change, _superseded(change))

    def forget(self) -> None:
        """Records that the server lost its scene, which must be sent again."""
        with self._lock:
            if self._newest is not None:
                self._newest = pending(self._newest.change, BUSY)

    def _resolve(self, change: Change, status: DeliveryStatus) -> None:
        outcome = self._awaited.pop(change, None)
        if outcome is not None:
            outcome.set_result(status)


def pending(change: Change, detail: str) -> DeliveryStatus:
    """Returns the status of a change that the server has not taken."""
    return DeliveryStatus("pending", change.scene_id, change.revision, detail)


def _superseded(change: Change) -> DeliveryStatus:
    detail = "A newer change was made before the render server had taken this one, and is shown in its place."
    return DeliveryStatus("superseded", change.scene_id, change.revision, detail)


def _known(status: DeliveryStatus) -> Future[DeliveryStatus]:
    outcome: Future[DeliveryStatus] = Future()
    outcome.set_result(status)
    return outcome
