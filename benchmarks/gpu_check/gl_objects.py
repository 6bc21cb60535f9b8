"""How many GL objects the driver holds: those that were never freed too, which Python has long forgotten."""

import ctypes
from collections.abc import Callable

from deltalight.protocol.errors import DeltalightError

KINDS = ("Buffer", "Texture", "Sampler", "Program", "Shader", "Framebuffer", "VertexArray", "Query")
HIGHEST_NAME = 8192
"""Drivers name objects from 1 on and use the names of freed ones again; some hundreds live at a time."""


def count_gl_objects() -> dict[str, int]:
    """Return the number of objects in the current context, by kind, as glIsBuffer and the like tell.

    Raises:
        DeltalightError: EGL knows no such function.
    """
    return {kind: sum(map(_is_one(kind), range(1, HIGHEST_NAME))) for kind in KINDS}


def _is_one(kind: str) -> Callable[[int], int]:
    """Whether a name is that of an object of this kind."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(f"glIs{kind}".encode())
    if address is None:
        raise DeltalightError(f"This driver has no glIs{kind}; update the graphics driver.")
    found: Callable[[int], int] = ctypes.CFUNCTYPE(ctypes.c_ubyte, ctypes.c_uint)(address)
    return found
