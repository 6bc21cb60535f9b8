"""A connection to PostgreSQL on which nobody waits for a server that keeps it open and says nothing."""

import time
from collections.abc import Generator
from typing import Any, TypeVar

import psycopg

from deltalight.services.storage.database import BUSY_TIMEOUT_S

SHORT_S = 3.0  # for questions whether it is there, and notifications
LONG_S = BUSY_TIMEOUT_S + 5.0  # for what may wait for another writer
Answer = TypeVar("Answer")
Waiting = Generator[Any, Any, Answer]  # as psycopg has it: yields what it waits for, is sent what came


class TimedConnection(psycopg.Connection[Any]):
    """Closes itself when an answer does not come in time: of a server that hangs, the kernel reports no fault.

    Outside of transactions (`autocommit`) an answer has `SHORT_S`, else `LONG_S`; without `is_timed` all the time
    that it takes.
    """

    is_timed = True

    def wait(self, gen: Waiting[Answer], *args: Any, **kwargs: Any) -> Answer:  # noqa: ANN401 (psycopg's)
        """Waits for an answer.

        Raises:
            psycopg.OperationalError: it did not come, and the connection is closed.
        """
        limited = self._limited(gen, SHORT_S if self.autocommit else LONG_S) if self.is_timed else gen
        return super().wait(limited, *args, **kwargs)

    def _limited(self, gen: Waiting[Answer], limit_s: float) -> Waiting[Answer]:
        """Passes on what `gen` waits for; psycopg resumes it ten times a second, also while nothing comes."""
        ends_s = time.monotonic() + limit_s
        try:
            wanted = next(gen)
            while True:
                ready = yield wanted
                if not ready and time.monotonic() >= ends_s:
                    gen.close()
                    self.close()
                    raise psycopg.OperationalError(f"no answer within {limit_s:g} s")
                wanted = gen.send(ready)
        except StopIteration as end:
            answer: Answer = end.value
            return answer
