"""A context that is lost when its GPU is reset: how the driver is made to report it, and what follows.

Sources: GL_KHR_robustness; EGL 1.5, 3.7.1.5; before 1.5, EGL_KHR_create_context.
"""

import ctypes
from collections.abc import Callable
from ctypes import byref, c_int, c_uint, c_void_p
from typing import ClassVar, Final, Protocol

import moderngl

from deltalight.protocol.errors import DeltalightError

EGL_NONE = 0x3038
EGL_CONFIG_ID = 0x3028
CONTEXT_ATTRIBUTES: Final = (
    *(0x3098, 4),  # EGL_CONTEXT_MAJOR_VERSION
    *(0x30FB, 3),  # EGL_CONTEXT_MINOR_VERSION
    *(0x30FD, 1),  # EGL_CONTEXT_OPENGL_PROFILE_MASK: core
    *(0x31BD, 0x31BF),  # EGL_CONTEXT_OPENGL_RESET_NOTIFICATION_STRATEGY: EGL_LOSE_CONTEXT_ON_RESET
    EGL_NONE,
)
RESETS: Final = {  # by what glGetGraphicsResetStatus returns
    0x8253: "by work of this process",  # GL_GUILTY_CONTEXT_RESET
    0x8254: "by work of another process",  # GL_INNOCENT_CONTEXT_RESET
}
UNKNOWN = "for a reason unknown to the driver"  # GL_UNKNOWN_CONTEXT_RESET


class GpuResetError(DeltalightError):
    """The context is gone with all that it held: only another process can render again.

    The process ends with EX_TEMPFAIL of sysexits.h: whoever supervises it starts it again.
    """

    exit_code: ClassVar[int] = 75


class GlContext(Protocol):
    """A context as moderngl uses one (`glcontext`)."""

    def load(self, name: str, /) -> int:
        """Returns the address of a function of OpenGL, 0 if there is none."""

    def release(self) -> None:
        """Destroys it."""

    def __enter__(self) -> object:
        """Makes it current."""

    def __exit__(self, *fault: object) -> object:
        """Makes none current."""


class ReportingContext:
    """A context on the display of another, which it replaces; its driver reports when the GPU was reset.

    Raises:
        OSError: the driver makes none.
    """

    def __init__(self, replaced: GlContext) -> None:
        self._replaced = replaced
        self._egl = egl = ctypes.CDLL("libEGL.so.1")
        for name in ("eglGetCurrentDisplay", "eglGetCurrentContext", "eglCreateContext"):
            getattr(egl, name).restype = c_void_p
        self._display = c_void_p(egl.eglGetCurrentDisplay())
        config = _config_of(egl, self._display, c_void_p(egl.eglGetCurrentContext()))
        attributes = (c_int * len(CONTEXT_ATTRIBUTES))(*CONTEXT_ATTRIBUTES)
        self._context = c_void_p(egl.eglCreateContext(self._display, config, None, attributes))
        if not self._context:
            raise OSError(f"eglCreateContext failed (0x{egl.eglGetError():x})")
        self.__enter__()
        replaced.release()

    def load(self, name: str, /) -> int:
        """Returns the address of a function, which is the same for all contexts of a driver; 0 if there is none."""
        return self._replaced.load(name)

    def release(self) -> None:
        """Destroys the context."""
        self._egl.eglDestroyContext(self._display, self._context)

    def __enter__(self) -> None:
        self._egl.eglMakeCurrent(self._display, None, None, self._context)

    def __exit__(self, *_fault: object) -> None:
        self._egl.eglMakeCurrent(self._display, None, None, None)


def _config_of(egl: ctypes.CDLL, display: c_void_p, context: c_void_p) -> c_void_p:
    """Returns the configuration that a context was made with."""
    number, found, config = c_int(), c_int(), c_void_p()
    egl.eglQueryContext(display, context, EGL_CONFIG_ID, byref(number))
    wanted = (c_int * 3)(EGL_CONFIG_ID, number.value, EGL_NONE)
    egl.eglChooseConfig(display, wanted, byref(config), 1, byref(found))
    return config


def reporting(context: GlContext) -> GlContext:
    """Returns a context that reports resets in place of the current one, or that if the driver makes none."""
    try:
        return ReportingContext(context)
    except OSError:
        return context


def reset_status(ctx: moderngl.Context, load: Callable[[str], int]) -> Callable[[], int]:
    """Returns what asks the driver whether the context was lost (not 0): a call of some 0.2 us, without waiting."""
    core = ctx.version_code >= 450 or "GL_KHR_robustness" in ctx.extensions
    if not core and "GL_ARB_robustness" not in ctx.extensions:
        return lambda: 0
    address = load("glGetGraphicsResetStatus" + ("" if core else "ARB"))
    ask: Callable[[], int] = ctypes.CFUNCTYPE(c_uint)(address)
    return ask


def check_reset(status: int) -> None:
    """Refuses to go on with a lost context.

    Raises:
        GpuResetError: `status` (of glGetGraphicsResetStatus) tells of a reset.
    """
    if status != 0:
        raise GpuResetError(
            f"The GPU was reset {RESETS.get(status, UNKNOWN)}, and all that this process had on it is lost: "
            "start it again."
        )
