"""Memory that nothing uses any more goes back to the kernel: what a method's passes, or many viewers, have left."""

import ctypes
import gc
import sys


def give_back_freed_memory() -> None:
    """Have glibc give back all pages that nothing uses, wherever they lie; other C libraries decide themselves.

    By itself it gives back what is free at the heap's end only. A software renderer's textures lie in the heap, and
    each change of method left it with other holes: some 100 MB at 96x72 pixels.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform.startswith("linux") else None
    if trim is not None:
        trim(0)


def give_back_garbage() -> None:
    """Collects what only refers to itself, as graphs do, and has its memory given back too.

    Python's next full collection may be hours away; until then, new arrays and textures would be placed around it.
    """
    gc.collect()
    give_back_freed_memory()
