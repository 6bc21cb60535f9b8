"""Returns unused memory to the operating system, after a method's passes or many viewers are gone."""

import ctypes
import gc
import sys


def give_back_freed_memory() -> None:
    """Has glibc release all unused pages of the heap; other C libraries decide themselves.

    By itself glibc releases only what is free at the heap's end. A software renderer's textures are in the heap, and
    each change of method left other holes in it: some 100 MB at 96x72 pixels.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform.startswith("linux") else None
    if trim is not None:
        trim(0)


def give_back_garbage() -> None:
    """Collects reference cycles, such as graphs, and releases their memory too.

    Python's next full collection may be hours away; until then, new arrays and textures would be placed around it.
    """
    gc.collect()
    give_back_freed_memory()
