"""What became of changes of the active scene at the render server, for those who wait to hear it."""

import threading
from collections.abc import Collection
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from typing import Literal

# Several pictures of a renderer in software (1 to 2 a second), and less than the 5 s after which common HTTP
# clients give up by themselves.
WAIT_S = 4.0
WAITERS = 8  # of the 40 threads that answer requests

SILENT = "The render server does not answer; the scene is shown as soon as it does."
BUSY = "The render server is still busy; the event `picture` tells when it has taken this."


@dataclass(frozen=True)
class Change:
    """A revision of a scene."""

    scene_id: str
    revision: int


@dataclass(frozen=True)
class Picture:
    """What became of a revision.

    `shown` = from the next frame on, `pending` = the server has not taken it yet, `refused` = it cannot render it
    and shows what it had before, `superseded` = a newer one was stored before the server had taken this one.
    """

    state: Literal["shown", "pending", "refused", "superseded"]
    scene_id: str
    revision: int
    detail: str = ""

    @property
    def change(self) -> Change:
        """Whose outcome this is."""
        return Change(self.scene_id, self.revision)


class Outcomes:
    """Tells each change what became of it: the newest one when it was sent, older ones at once (any thread)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: Picture | None = None
        self._awaited: dict[Change, Future[Picture]] = {}
        self._places = threading.BoundedSemaphore(WAITERS)

    @property
    def newest(self) -> Picture | None:
        """What the last sending came to."""
        return self._newest

    @property
    def awaited(self) -> Collection[Change]:
        """Changes that nobody knows the outcome of yet."""
        with self._lock:
            return tuple(self._awaited)

    def expect(self, change: Change) -> Future[Picture]:
        """What will have become of a change that is stored; older ones of its scene hear that they are superseded."""
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

    def wait(self, change: Change, outcome: Future[Picture]) -> Picture:
        """The outcome of a change; `pending` where it is not known soon, or too many wait already."""
        if outcome.done():
            return outcome.result()
        if not self._places.acquire(blocking=False):
            return pending(change, BUSY)
        try:
            return outcome.result(WAIT_S)
        except FutureTimeoutError:
            return pending(change, BUSY)
        finally:
            self._places.release()

    def note(self, picture: Picture, awaited: Collection[Change]) -> None:
        """Tell what a sending came to; `awaited` were stored before it was looked what is the newest."""
        with self._lock:
            self._newest = picture
            self._tell(picture.change, picture)
            for change in awaited:
                self._tell(change, _superseded(change))

    def forget(self) -> None:
        """The server has lost what it was sent, and is to get it again."""
        with self._lock:
            if self._newest is not None:
                self._newest = pending(self._newest.change, BUSY)

    def _tell(self, change: Change, picture: Picture) -> None:
        outcome = self._awaited.pop(change, None)
        if outcome is not None:
            outcome.set_result(picture)


def pending(change: Change, detail: str) -> Picture:
    """The server has not taken this change."""
    return Picture("pending", change.scene_id, change.revision, detail)


def _superseded(change: Change) -> Picture:
    detail = "A newer change was made before the render server had taken this one, and is shown in its place."
    return Picture("superseded", change.scene_id, change.revision, detail)


def _known(picture: Picture) -> Future[Picture]:
    outcome: Future[Picture] = Future()
    outcome.set_result(picture)
    return outcome
