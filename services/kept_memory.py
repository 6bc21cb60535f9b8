"""Keeping freed memory for the next arrays, instead of giving it back to the kernel after each frame."""

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc, malloc.h
_MMAP_THRESHOLD_BYTES = 1 << 25  # glibc accepts no higher threshold
_TRIM_THRESHOLD_BYTES = 1 << 28


def keep_freed_memory() -> None:
    """Makes glibc keep up to 256 MB of what this process frees; has no effect with other C libraries.

    A node creates and frees dozens of arrays of several megabytes for each frame. To get them from the kernel each
    time, mapped and zeroed anew, takes a fifth of its processor time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD_BYTES)
