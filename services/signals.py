"""Termination of long-running commands: signals become exceptions, so that every `finally` runs."""

import os
import signal
import sys
import threading
from types import FrameType, TracebackType

AGAIN_AFTER_S = 0.02


class Terminated(BaseException):
    """SIGTERM was received; not an `Exception`, so that no handler of faults swallows it."""


class Interrupted(KeyboardInterrupt):
    """SIGINT was received.

    Where a `KeyboardInterrupt` itself leaves code that was compiled from a string (dataclasses are), Python ends the
    process by SIGINT at its exit, whoever caught it meanwhile.
    """


def raise_signals() -> None:
    """Makes SIGTERM raise `Terminated` in the main thread, once, and SIGINT `Interrupted` unless it is ignored.

    Linux signals the death of a supervisor once for each of its threads that dies: a second exception would interrupt
    the clean-up that the first one started.
    """
    signal.signal(signal.SIGTERM, _raise_terminated)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _raise_interrupted)
    sys.unraisablehook = _deliver_again
    sys.excepthook = _print_faults


def _raise_interrupted(_number: int, _frame: FrameType | None) -> None:
    raise Interrupted


def _raise_terminated(_number: int, _frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Terminated


def _print_faults(kind: type[BaseException], fault: BaseException, trace: TracebackType | None) -> None:
    """Prints what nobody caught, but no signal: compiled code prints one here before `_deliver_again` resends it."""
    if not issubclass(kind, KeyboardInterrupt | Terminated):
        sys.__excepthook__(kind, fault, trace)


def _deliver_again(lost: "sys.UnraisableHookArgs") -> None:
    """Resends a signal that was lost with a traceback because it arrived while an object was freed."""
    if isinstance(lost.exc_value, Terminated):
        signal.signal(signal.SIGTERM, _raise_terminated)
        again = signal.SIGTERM
    elif isinstance(lost.exc_value, KeyboardInterrupt):
        again = signal.SIGINT
    else:
        sys.__unraisablehook__(lost)
        return
    threading.Timer(AGAIN_AFTER_S, os.kill, (os.getpid(), again)).start()
