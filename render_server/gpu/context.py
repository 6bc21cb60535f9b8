"""The OpenGL context of a process (EGL, headless)."""

import ctypes
import os
from collections import Counter
from collections.abc import Callable, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Protocol
from weakref import WeakKeyDictionary

import glcontext
import moderngl

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.buffer_images import TextureCalls
from deltalight.render_server.gpu.lost_context import check_reset, reporting, reset_status
from deltalight.render_server.gpu.precompile_queue import PrecompileQueue

SPARE_PROGRAMS = 256  # kept linked while no kernel uses them: renderers are made again when settings change
THREADS = Path("/proc/self/task")
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swiftshader", "swrast")

# What EGL and the GL loader say, and what a user can do about it.
HINTS = {
    "libGL.so not loaded": "OpenGL is not installed: apt-get install --no-install-recommends libegl1 libgl1",
    "libEGL.so not loaded": "EGL is not installed: apt-get install --no-install-recommends libegl1 libgl1",
    "eglInitialize failed": "EGL found no driver: install libgl1-mesa-dri, or the NVIDIA driver's EGL library",
    "XOpenDisplay": "a display was requested, but there is none: use the EGL backend",
    "eglCreateContext failed": "the driver offers less than OpenGL 4.3: update the graphics driver",
    "found 0 devices": "EGL sees no device: install libgl1-mesa-dri or the graphics driver; in a container, pass"
    " the GPU with its graphics capability",
    "requested device": "there is no such GPU; name no device, or one that `deltalight doctor` lists",
}

# What the assembled shaders and the buffers of a small scene need of a device, by OpenGL's name. Devices that conform
# to OpenGL 4.3 have it; tests/render_server/test_shader_conformance.py holds the shaders to it.
NEEDED: Final[Mapping[str, int]] = {
    "GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS": 8,
    "GL_MAX_SHADER_STORAGE_BUFFER_BINDINGS": 8,
    "GL_MAX_SHADER_STORAGE_BLOCK_SIZE": 2**24,
    "GL_MAX_COMPUTE_TEXTURE_IMAGE_UNITS": 16,
    "GL_MAX_TEXTURE_IMAGE_UNITS": 16,
    "GL_MAX_COMPUTE_IMAGE_UNIFORMS": 8,
    "GL_MAX_COMPUTE_UNIFORM_BLOCKS": 12,
    "GL_MAX_COMPUTE_SHARED_MEMORY_SIZE": 32768,
    "GL_MAX_COMPUTE_WORK_GROUP_INVOCATIONS": 1024,
    "GL_MAX_3D_TEXTURE_SIZE": 1024,
}
UNLISTED: Final = {  # limits that moderngl does not list
    "GL_MAX_COMPUTE_IMAGE_UNIFORMS": 0x91BD,
    "GL_MAX_COMPUTE_SHARED_MEMORY_SIZE": 0x8262,
}

NO_ERROR, OUT_OF_MEMORY = "GL_NO_ERROR", "GL_OUT_OF_MEMORY"  # as moderngl names them

OBJECT_KINDS = ("Buffer", "Texture", "Sampler", "Program", "Shader", "Framebuffer", "VertexArray", "Query")
COPY_WRITE_BUFFER, R32UI, RED_INTEGER, UNSIGNED_INT = 0x8F37, 0x8236, 0x8D94, 0x1405  # OpenGL's numbers
MOST_GROUP_COUNTERS = 256
HIGHEST_NAME = 8192  # drivers that use freed names again stay below: some hundreds of objects live at a time


class GpuMemoryError(DeltalightError):
    """The driver had no memory for what it was asked; OpenGL's state is undefined now (OpenGL 4.3, 2.3.1)."""


CompileWatcher = Callable[[str, Mapping[str, str]], None]


class SharedProgram(Protocol):
    """A linked program and the ids of what uses it."""

    users: set[int]

    def release(self) -> None:
        """Frees the GL object."""


class SharedPrograms:
    """Linked programs by source: kernels of the same source share one, and the next ones find it again."""

    def __init__(self) -> None:
        self._programs: dict[tuple[str, ...], SharedProgram] = {}  # the longest unused first

    def __len__(self) -> int:
        """Returns how many are linked."""
        return len(self._programs)

    def take(self, user: object, source: tuple[str, ...], link: Callable[[], SharedProgram]) -> SharedProgram:
        """Returns the program of that source for `user`; `link` makes it where there is none."""
        program = self._programs.pop(source, None) or link()
        self._programs[source] = program
        program.users.add(id(user))
        return program

    def give_back(self, user: object, program: SharedProgram) -> None:
        """Takes back what `user` took; frees the oldest programs beyond SPARE_PROGRAMS that nobody uses."""
        program.users.discard(id(user))
        spare = [source for source, item in self._programs.items() if not item.users]
        for source in spare[: max(0, len(spare) - SPARE_PROGRAMS)]:
            self._programs.pop(source).release()


@dataclass(frozen=True)
class GpuContext:
    """A current OpenGL 4.3 context and its device.

    One process has one context and uses it from one thread.
    """

    ctx: moderngl.Context
    renderer_name: str
    version: str
    is_software: bool
    watchers: list[Callable[[Any], None]] = field(default_factory=list)
    """Told of every run of a kernel (gpu/kernel.py)."""
    compile_watchers: list[CompileWatcher] = field(default_factory=list)
    """Told of every program that a kernel asks for, when it first runs: its label and the text of each stage."""

    programs: SharedPrograms = field(default_factory=SharedPrograms)
    precompile_queue: PrecompileQueue = field(default_factory=PrecompileQueue)
    reset_status: Callable[[], int] = lambda: 0
    """Asks the driver whether the context was lost (lost_context.py); 0 = it was not."""
    most_images: int = NEEDED["GL_MAX_COMPUTE_IMAGE_UNIFORMS"]
    """Images of a kernel."""
    defers_draws: bool = False
    """A dispatch may run before earlier draws and clears: in llvmpipe, if what they change was bound before."""
    compiles_unrun: bool = False
    """Kernels compile their program without switches when they are made, for checks of shaders that run none."""
    errors: Counter[str] = field(default_factory=Counter)
    """Errors of OpenGL that `check` found, by name; each is a fault of this program or of the driver."""

    def check(self) -> None:
        """Finds what went wrong since the last call; does not wait for the GPU.

        Raises:
            GpuResetError: the context is lost, and what was read from it is worthless.
            GpuMemoryError: something could not be stored.
        """
        check_reset(self.reset_status())
        self._release_unreferenced()
        error = self.ctx.error
        if error == OUT_OF_MEMORY:
            raise GpuMemoryError(
                "The GPU's memory is full, so nothing is rendered: stop other programs that use it, or lower the"
                " size of output, method.volume_size or method.memory_budget_mb."
            )
        if error != NO_ERROR:
            self.errors[error] += 1

    def _release_unreferenced(self) -> None:
        """Frees what nobody refers to any more, such as the passes of a graph that failed while it was declared."""
        while self.ctx.objects:
            release = getattr(self.ctx.objects.popleft(), "release", None)  # what was freed before has none
            if release is not None:
                release()

    @cached_property
    def defines(self) -> dict[str, str]:
        """What all shaders are compiled with: SOFTWARE, and the cores that then share a kernel (common/walk.glsl)."""
        return {"SOFTWARE": "1", "CORES": f"{os.cpu_count() or 1}u"} if self.is_software else {}

    def compiled(self, label: str, sources: Mapping[str, str]) -> None:
        """Tells the compile watchers about a program."""
        for watch in self.compile_watchers:
            watch(label, sources)

    @cached_property
    def common(self) -> dict[str, object]:
        """What is made once and used by all, by name: the kernels that clear and count (gpu/kernel.py)."""
        return {}

    @cached_property
    def _empty_textures(self) -> dict[tuple[type, str, int], Any]:
        return {}

    def empty_texture(self, kind: type, dtype: str, components: int) -> Any:  # noqa: ANN401 (as the kind says)
        """A texture of zeros that stands where a kernel is given none."""
        if (kind, dtype, components) not in self._empty_textures:
            makers: dict[type, tuple[Any, tuple[int, ...]]] = {
                moderngl.Texture: (self.ctx.texture, (1, 1)),
                moderngl.Texture3D: (self.ctx.texture3d, (1, 1, 1)),
                moderngl.TextureArray: (self.ctx.texture_array, (1, 1, 1)),
            }
            make, size = makers[kind]
            texture = make(size, components, bytes(components * int(dtype[1])), dtype=dtype, alignment=1)
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._empty_textures[kind, dtype, components] = texture
        return self._empty_textures[kind, dtype, components]

    @cached_property
    def texture_calls(self) -> TextureCalls:
        """OpenGL's functions for what moderngl does not know."""
        return TextureCalls(self.ctx)

    @cached_property
    def empty_buffer(self) -> moderngl.Buffer:
        """A buffer of zeros that stands where a kernel reads from none."""
        return self.ctx.buffer(bytes(256))

    @cached_property
    def group_counters(self) -> moderngl.Buffer:
        """Counters of workgroups that are done, all 0 between dispatches: the last one of each sets its own back."""
        return self.ctx.buffer(bytes(4 * MOST_GROUP_COUNTERS))

    @cached_property
    def used_up(self) -> MutableMapping[moderngl.Buffer, int]:
        """Buffers to be cleared when the next frame begins, and how many bytes of each (gpu/clearing.py)."""
        return WeakKeyDictionary()

    @cached_property
    def cleared_ahead(self) -> MutableMapping[moderngl.Buffer, int]:
        """Buffers that were cleared before anybody needs them, and how many bytes of each."""
        return WeakKeyDictionary()

    @cached_property
    def discarded_buffer(self) -> moderngl.Buffer:
        """The buffer that stands where a kernel may write to none."""
        return self.ctx.buffer(bytes(256))

    def storage_buffer(self, size: int, lower: str) -> moderngl.Buffer:
        """Reserves `size` bytes that shaders read or write; `lower` is as in `check_storage`."""
        self.check_storage(size, lower)
        return self.ctx.buffer(reserve=size)

    def check_storage(self, size: int, lower: str) -> None:
        """Refuses a buffer beyond what shaders reach of one: what they write there would be lost without a word.

        `lower` names the settings of the scene document that make it smaller.

        Raises:
            DeltalightError: `size` (bytes) is beyond the limit.
        """
        limit = self.ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]
        if size > limit:
            raise DeltalightError(
                f"A buffer of {size / 1e6:.0f} MB is needed, and shaders of this GPU reach {limit / 1e6:.0f} MB "
                f"of one: lower {lower}."
            )

    def settle_draws(self) -> None:
        """Before a dispatch: ends earlier draws and clears where the driver puts them off."""
        if self.defers_draws:
            self.ctx.memory_barrier()

    def clear_start(self, buffer: moderngl.Buffer, size: int) -> None:
        """Sets the first few bytes of a buffer to zero (a multiple of 4), on the GPU; more of it: `clear_buffer`.

        `Buffer.write` would let drivers move the buffer to where the CPU writes faster.
        """
        bind, clear = self._clearing
        bind(COPY_WRITE_BUFFER, buffer.glo)
        clear(COPY_WRITE_BUFFER, R32UI, 0, size, RED_INTEGER, UNSIGNED_INT, None)

    @cached_property
    def _clearing(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """glBindBuffer and glClearBufferSubData, which moderngl lacks."""
        load, number, size = self.ctx.mglo._context.load, ctypes.c_uint, ctypes.c_ssize_t
        bind = ctypes.CFUNCTYPE(None, number, number)
        clear = ctypes.CFUNCTYPE(None, number, number, size, size, number, number, ctypes.c_void_p)
        return bind(load("glBindBuffer")), clear(load("glClearBufferSubData"))

    @cached_property
    def spare_queries(self) -> list[moderngl.Query]:
        """Timer queries that nobody uses: moderngl frees none, so they pass from one renderer to the next."""
        return []

    @cached_property
    def flush(self) -> Callable[[], None]:
        """glFlush, which moderngl lacks: hands the GPU what was issued so far.

        It does not wait, and keeps the interpreter meanwhile: another thread might hold that for milliseconds.
        """
        return ctypes.PYFUNCTYPE(None)(self.ctx.mglo._context.load("glFlush"))

    def release(self) -> None:
        """Frees the context; nothing made from it may be used afterwards."""
        self.ctx.release()


def is_software_renderer(name: str) -> bool:
    """Whether the renderer string names a CPU rasteriser."""
    return any(word in name.lower() for word in SOFTWARE_RENDERERS)


def explain_context_failure(text: str) -> str:
    """Returns one sentence that explains the error text of a failed context creation."""
    for needle, hint in HINTS.items():
        if needle in text:
            return f"No OpenGL context ({text}): {hint}."
    return f"No OpenGL context ({text}): run `deltalight doctor` to see what is missing."


def check_limits(renderer: str, limits: Mapping[str, int]) -> None:
    """Refuses a device that has less of anything than NEEDED.

    Raises:
        DeltalightError: names the limit, what the device has and what is needed.
    """
    for name, needed in NEEDED.items():
        if limits[name] < needed:
            raise DeltalightError(
                f"{renderer} has {name} {limits[name]}, and {needed} is needed: "
                "update the graphics driver, or choose another GPU."
            )


def limits_of(ctx: moderngl.Context) -> dict[str, int]:
    """Returns the limits of the current device that NEEDED names."""
    address = ctx.mglo._context.load("glGetIntegerv")
    read = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.POINTER(ctypes.c_int))(address)
    limits = {name: int(ctx.info[name]) for name in NEEDED if name not in UNLISTED}
    for name, number in UNLISTED.items():
        value = ctypes.c_int()
        read(number, ctypes.byref(value))
        limits[name] = value.value
    return limits


def count_gl_objects() -> dict[str, int]:
    """Returns the number of objects in the current context, by kind, as glIsBuffer and the like tell.

    It counts those too that were never freed, which Python has long forgotten.

    Raises:
        DeltalightError: EGL knows no such function.
    """
    return {kind: _count(kind) for kind in OBJECT_KINDS}


def _count(kind: str) -> int:
    """Counts objects up to the newest name: Mesa counts upwards, and does not use freed names again."""
    is_one = _gl_function(f"glIs{kind}", ctypes.c_ubyte, ctypes.c_uint)
    newest = _new_name("Program" if kind == "Shader" else kind)  # which share their names
    return sum(map(is_one, range(1, max(HIGHEST_NAME, newest) + 1)))


def _new_name(kind: str) -> int:
    """Makes an object of this kind and frees it; returns its name."""
    if kind == "Program":
        name = int(_gl_function("glCreateProgram", ctypes.c_uint)())
        _gl_function("glDeleteProgram", None, ctypes.c_uint)(name)
        return name
    names, plural = (ctypes.c_uint * 1)(), "Queries" if kind == "Query" else f"{kind}s"
    for verb in ("Gen", "Delete"):
        _gl_function(f"gl{verb}{plural}", None, ctypes.c_int, ctypes.POINTER(ctypes.c_uint))(1, names)
    return names[0]


def _gl_function(name: str, result: Any, *arguments: Any) -> Callable[..., Any]:  # noqa: ANN401 (types of ctypes)
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(name.encode())
    if address is None:
        raise DeltalightError(f"This driver has no {name}; update the graphics driver.")
    found: Callable[..., Any] = ctypes.CFUNCTYPE(result, *arguments)(address)
    return found


def create_context(device: int | None = None, *, allow_software: bool = True) -> GpuContext:
    """Creates the process's context on EGL device `device` (default: the driver's first).

    Raises:
        DeltalightError: there is no driver, no such device, one that has too little of something, or only a
            software renderer although none is allowed.
    """
    try:
        context: Any = reporting(glcontext.get_backend_by_name("egl")(glversion=430, device_index=device))
        ctx = moderngl.create_context(require=430, standalone=True, context=context)
    except Exception as error:  # moderngl and glcontext raise plain Exception
        raise DeltalightError(explain_context_failure(str(error))) from error
    ctx.gc_mode = "context_gc"  # collects what is to be freed; `check` does that, on the context's thread
    name = str(ctx.info["GL_RENDERER"])
    software = is_software_renderer(name)
    if software and not allow_software:
        ctx.release()
        raise DeltalightError(
            f"Only the software renderer {name} was found: "
            "install a GPU driver, or add --allow-software to accept slow frames."
        )
    try:
        limits = limits_of(ctx)
        check_limits(name, limits)
    except DeltalightError:
        ctx.release()
        raise
    if software:
        spread_raster_threads()
    ask = reset_status(ctx, context.load)
    images = limits["GL_MAX_COMPUTE_IMAGE_UNIFORMS"]
    version = str(ctx.info["GL_VERSION"])
    return GpuContext(
        ctx, name, version, software, reset_status=ask, most_images=images, defers_draws=software
    )


def spread_raster_threads() -> None:
    """Keeps each of llvmpipe's raster threads on a core of its own (Linux).

    They are woken together for a millisecond or two of work. Linux often wakes two of them on one core, and does not
    part them before they are done.
    """
    if not THREADS.is_dir():
        return
    cores = sorted(os.sched_getaffinity(0))
    for thread in THREADS.iterdir():
        with suppress(OSError):  # it has ended, or this process may not
            kind, _, number = (thread / "comm").read_text().strip().rpartition("-")
            if kind == "llvmpipe" and number.isdecimal():
                os.sched_setaffinity(int(thread.name), {cores[int(number) % len(cores)]})
