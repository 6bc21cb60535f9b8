"""Ends a supervised child with its supervisor, even a killed one, by the kernel's parent-death signal."""

import ctypes
import os
import signal
import sys

SUPERVISOR_VARIABLE = "DELTALIGHT_SUPERVISOR_PID"
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with_supervisor() -> None:
    """Requests SIGTERM from the kernel at the supervisor's death, if a supervisor started this process."""
    supervisor = os.environ.pop(SUPERVISOR_VARIABLE, None)
    if supervisor is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != int(supervisor):  # it died before the request took effect
        sys.exit(0)
