"""How a long-running command ends: SIGTERM becomes an exception, so that every `finally` runs."""

import signal
from types import FrameType


class Terminated(BaseException):
    """SIGTERM was received; not an `Exception`, so that no handler of faults swallows it."""


def raise_on_sigterm() -> None:
    """Make SIGTERM raise `Terminated` in the main thread (SIGINT raises `KeyboardInterrupt` already)."""
    signal.signal(signal.SIGTERM, _raise_terminated)


def _raise_terminated(_number: int, _frame: FrameType | None) -> None:
    raise Terminated
