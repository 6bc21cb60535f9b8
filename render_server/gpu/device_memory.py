"""Memory of the device that a context renders on: what the driver tells of a GPU, the host's in software."""

import ctypes
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from deltalight.render_server.gpu.context import create_context

_NVX, _ATI = "GL_NVX_gpu_memory_info", "GL_ATI_meminfo"
_DEDICATED_NVX, _AVAILABLE_NVX = 0x9047, 0x9049  # kB (NVX_gpu_memory_info)
# kB free, of all and of the largest block, the same of auxiliary memory (ATI_meminfo).
_TEXTURE_FREE_ATI = 0x87FC
_CONTROL_GROUP, _USED_BY_IT = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
_MEMORY = Path("/proc/meminfo")

Integers = Callable[[int, int], list[int]]  # glGetIntegerv: the name of a value, and how many numbers it has


@dataclass(frozen=True)
class FoundDevice:
    """What a process finds on an EGL device; `memory_bytes` is None where the driver does not tell."""

    name: str
    is_software: bool
    memory_bytes: int | None
    free_bytes: int | None = None


def find_device(device: int | None = None) -> FoundDevice:
    """Creates a context on an EGL device (None = the driver's first) and asks it; the process has no other context.

    Raises:
        DeltalightError: there is no such device, or no OpenGL.
    """
    gpu = create_context(device)
    try:
        total, free = device_memory(gpu.ctx.extensions, gl_integers(), is_software=gpu.is_software)
        return FoundDevice(gpu.renderer_name, gpu.is_software, total, free)
    finally:
        gpu.release()


def device_memory(
    extensions: Collection[str], integers: Integers, *, is_software: bool
) -> tuple[int | None, int | None]:
    """Returns all memory and what is free of it, bytes, None where the driver does not tell.

    ATI_meminfo tells what is free alone, which stands for all.
    """
    if is_software:
        return host_memory(), None
    if _NVX in extensions:
        return integers(_DEDICATED_NVX, 1)[0] * 1024, integers(_AVAILABLE_NVX, 1)[0] * 1024
    if _ATI in extensions:
        free = integers(_TEXTURE_FREE_ATI, 4)[0] * 1024
        return free, free
    return None, None


def host_memory() -> int:
    """Returns the memory of this host, or of the control group (a container's limit) where that is less, bytes."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(memory, int(_CONTROL_GROUP.read_text()))
    except (OSError, ValueError):  # no control groups, or "max"
        return memory


def free_host_memory() -> int:
    """Returns what is free of `host_memory`, bytes; 0 where that is unknown."""
    try:
        lines = dict(line.split(":") for line in _MEMORY.read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return 0
    try:
        return min(free, int(_CONTROL_GROUP.read_text()) - int(_USED_BY_IT.read_text()))
    except (OSError, ValueError):
        return free


def gl_integers() -> Integers:
    """Returns glGetIntegerv of the current context."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(b"glGetIntegerv")
    ask = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.POINTER(ctypes.c_int))(address)

    def integers(name: int, count: int) -> list[int]:
        values = (ctypes.c_int * count)()
        ask(name, values)
        return list(values)

    return integers
