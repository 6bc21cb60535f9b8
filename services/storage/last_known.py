"""Answers of the last reads, for the time while the database is away."""

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock
from typing import Any, TypeVar

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.faults import DatabaseGoneError, StorageFaultError

LIFE_S = 600.0  # a token that was revoked meanwhile is taken no longer than that
LATELY_S, LONG_S = 60.0, 3600.0
MOST_ANSWERS = 256
Answer = TypeVar("Answer")


@dataclass
class _Known:
    answer: Any
    read: Callable[[], Any]
    read_s: float  # when the read began, of the monotonic clock
    asked_s: float


class LastKnown:
    """Keeps the answers of the reads that were asked last (any thread)."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._all_due_s = clock_s() + LATELY_S
        self._kept: tuple[Callable[[], object], ...] = ()
        self._known: OrderedDict[Hashable, _Known] = OrderedDict()
        self._lock = Lock()

    def answer(self, key: Hashable, read: Callable[[], Answer]) -> Answer:
        """Returns what `read` returns; where the database is away, what it returned at most `LIFE_S` ago.

        Raises:
            DatabaseGoneError: the database is away, and nothing is known.
        """
        return self._answer(key, read, self._clock_s())

    def _answer(self, key: Hashable, read: Callable[[], Answer], asked_s: float) -> Answer:
        begun_s = self._clock_s()
        try:
            answer = read()
        except DatabaseGoneError:
            with self._lock:
                known = self._known.get(key)
            if known is None or known.read_s < self._clock_s() - LIFE_S:
                raise
            return known.answer  # type: ignore[no-any-return]
        except StorageFaultError:  # which says nothing of the answer
            raise
        except DeltalightError:
            with self._lock:
                self._known.pop(key, None)
            raise
        self._note(key, _Known(answer, read, begun_s, asked_s))
        return answer

    def note(self, key: Hashable, answer: Answer, read: Callable[[], Answer]) -> None:
        """Notes what `read` would answer now."""
        now_s = self._clock_s()
        self._note(key, _Known(answer, read, now_s, now_s))

    def _note(self, key: Hashable, found: _Known) -> None:
        """Notes an answer unless a read that began later, on another thread, has given one."""
        with self._lock:
            known = self._known.get(key)
            if known is not None:
                known.asked_s = found.asked_s = max(known.asked_s, found.asked_s)
                if known.read_s > found.read_s:
                    return
            self._known[key] = found
            self._known.move_to_end(key)
            if len(self._known) > MOST_ANSWERS:
                self._known.popitem(last=False)

    def keep(self, *reads: Callable[[], object]) -> None:
        """Makes these reads, each by way of `answer`, now and whenever others are made again."""
        self._kept = reads
        self._read_kept()

    def _read_kept(self) -> None:
        for read in self._kept:
            with suppress(DeltalightError):
                read()

    def tick(self, *, is_changed: bool) -> None:
        """Reads again what was asked lately if something `is_changed`, and each minute what was within an hour."""
        now_s = self._clock_s()
        if now_s >= self._all_due_s:
            self._all_due_s = now_s + LATELY_S
            self._refresh(now_s - LONG_S)
        elif is_changed:
            self._refresh(now_s - LATELY_S)

    def _refresh(self, since_s: float) -> None:
        self._read_kept()
        with self._lock:
            asked = [(key, known) for key, known in self._known.items() if known.asked_s >= since_s]
        for key, known in asked:
            with suppress(DeltalightError):
                self._answer(key, known.read, known.asked_s)  # it was not asked for now
