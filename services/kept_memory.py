"""Freed memory is kept for the next arrays, not given back to the kernel after each frame."""

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc, malloc.h
_MOST_MAPPED_APART = 1 << 25  # bytes; glibc takes no greater threshold
_KEPT_BYTES = 1 << 28


def keep_freed_memory() -> None:
    """Have glibc keep up to 256 MB of what this process frees; other C libraries stay as they are.

    A node makes and drops dozens of arrays of megabytes for each frame. To get them from the kernel each time, mapped
    and cleared anew, takes a fifth of its processor time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MOST_MAPPED_APART)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
