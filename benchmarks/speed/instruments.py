"""What a frame asks of OpenGL: counted, remembered, or left out, by wrapping moderngl's own methods for a while."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import AsyncReadback, DelayedRead, sizes_bytes

Wrap = Callable[[Any], Any]
"""Takes what a class has under a name, and returns what stands there instead."""
Wrapped = tuple[type, str, Wrap]

TEXTURES = (moderngl.Texture, moderngl.Texture3D, moderngl.TextureArray)
MAKERS = ("texture", "texture3d", "texture_array")


@contextmanager
def wrapped(members: Iterable[Wrapped]) -> Iterator[None]:
    """Replaces members of classes, and puts them back."""
    before: list[tuple[type, str, Any]] = []
    try:
        for owner, name, wrap in members:
            before.append((owner, name, vars(owner)[name]))
            setattr(owner, name, wrap(vars(owner)[name]))
        yield
    finally:
        for owner, name, original in reversed(before):
            setattr(owner, name, original)


@dataclass
class GpuCounts:
    """What was asked of OpenGL.

    `buffer_clears` are those of moderngl, which maps the buffer and clears it on the CPU; `uploaded_bytes` go into
    buffers and textures, those of newly made ones included, in so many `uploads`. `reads` wait for the GPU; the
    finished picture's own and those of earlier frames' numbers are not counted. `uniform_writes` are of single
    uniforms: blocks are uploads.
    """

    dispatches: int = 0
    draws: int = 0
    framebuffer_clears: int = 0
    buffer_clears: int = 0
    buffer_clear_bytes: int = 0
    uploads: int = 0
    uploaded_bytes: int = 0
    reads: int = 0
    uniform_writes: int = 0


class _Counter:
    """Counts into `counts` what the wrapped methods are called with."""

    def __init__(self) -> None:
        self.counts = GpuCounts()
        self._reads_picture = False

    def wraps(self) -> list[Wrapped]:
        """Everything that is counted."""
        writes = [(owner, "write", _noting(self._upload)) for owner in (moderngl.Buffer, *TEXTURES)]
        makers = [(moderngl.Context, name, _noting(self._make_texture)) for name in MAKERS]
        reads = [(owner, name, _noting(self._read)) for owner, name in READS]
        late = ((AsyncReadback, "push"), (AsyncReadback, "pop"), (DelayedRead, "pop"))
        picture = [(owner, name, self._excepting_reads) for owner, name in late]
        return [
            *((owner, name, _noting(self._dispatch)) for owner, name in DISPATCHES),
            *((owner, name, _noting(self._draw)) for owner, name in DRAWS),
            (moderngl.Framebuffer, "clear", _noting(self._clear_framebuffer)),
            (moderngl.Buffer, "clear", _noting(self._clear_buffer)),
            *writes,
            (moderngl.Context, "buffer", _noting(self._make_buffer)),
            *makers,
            *reads,
            *picture,
            (moderngl.Uniform, "write", _noting(self._write_uniform)),
        ]

    def _dispatch(self, *_: object) -> None:
        self.counts.dispatches += 1

    def _draw(self, *_: object, **__: object) -> None:
        self.counts.draws += 1

    def _clear_framebuffer(self, *_: object, **__: object) -> None:
        self.counts.framebuffer_clears += 1

    def _clear_buffer(
        self, buffer: moderngl.Buffer, size: int = -1, offset: int = 0, chunk: bytes | None = None
    ) -> None:
        del chunk
        self.counts.buffer_clears += 1
        self.counts.buffer_clear_bytes += buffer.size - offset if size < 0 else size

    def _upload(self, _: object, data: Any, *__: object, **___: object) -> None:  # noqa: ANN401 (any buffer)
        if not isinstance(data, moderngl.Buffer):  # what the GPU has is copied there
            self.counts.uploads += 1
            self.counts.uploaded_bytes += memoryview(data).nbytes

    def _make_buffer(self, _: object, data: Any = None, **__: object) -> None:  # noqa: ANN401 (any buffer)
        if data is not None:
            self._upload(None, data)

    def _make_texture(self, _: object, *given: Any, **named: Any) -> None:  # noqa: ANN401 (size, components, data)
        data = given[2] if len(given) > 2 else named.get("data")
        self._make_buffer(None, data)

    def _read(self, *_: object, **__: object) -> None:
        self.counts.reads += not self._reads_picture

    def _write_uniform(self, *_: object) -> None:
        self.counts.uniform_writes += 1

    def _excepting_reads(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def call(*given: Any, **named: Any) -> Any:  # noqa: ANN401 (as the wrapped method)
            self._reads_picture = True
            try:
                return original(*given, **named)
            finally:
                self._reads_picture = False

        return call


DISPATCHES = ((moderngl.ComputeShader, "run"), (moderngl.ComputeShader, "run_indirect"))
DRAWS = ((moderngl.VertexArray, "render"), (moderngl.VertexArray, "render_indirect"))
BYTE_READS = tuple((owner, "read") for owner in (moderngl.Buffer, *TEXTURES))
READS_INTO = tuple((owner, "read_into") for owner in (moderngl.Buffer, *TEXTURES))
READS = (*BYTE_READS, *READS_INTO, (moderngl.Framebuffer, "read"))
CLEARS = ((moderngl.Framebuffer, "clear"), (moderngl.Buffer, "clear"), (GpuContext, "clear_start"))
# What a driver may work at when it is told: software renderers do.
WAITS = ((moderngl.Context, "memory_barrier"), (moderngl.Query, "__enter__"), (moderngl.Query, "__exit__"))
COPIES = ((moderngl.Context, "copy_buffer"), (moderngl.Context, "copy_framebuffer"))
TEXTURE_WRITES = tuple((owner, "write") for owner in TEXTURES)
MIPMAPS = tuple((owner, "build_mipmaps") for owner in TEXTURES)


def _noting(note: Callable[..., None]) -> Wrap:
    """Calls `note` with the arguments before the method."""

    def wrap(original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def call(*given: Any, **named: Any) -> Any:  # noqa: ANN401 (as the wrapped method)
            note(*given, **named)
            return original(*given, **named)

        return call

    return wrap


@contextmanager
def counted() -> Iterator[GpuCounts]:
    """Counts what is asked of OpenGL inside; the GPU does its work as ever."""
    counter = _Counter()
    with wrapped(counter.wraps()):
        yield counter.counts


class ReadBacks:
    """What was last read of buffers and textures, so that frames without a GPU take the same branches."""

    def __init__(self) -> None:
        self._held: dict[tuple[object, ...], bytes] = {}

    @contextmanager
    def remembered(self) -> Iterator[None]:
        """Remembers what is read inside."""
        with wrapped((owner, name, self._remembering) for owner, name in BYTE_READS):
            yield

    def _remembering(self, original: Callable[..., bytes]) -> Callable[..., bytes]:
        @wraps(original)
        def call(item: Any, *given: int, **named: int) -> bytes:  # noqa: ANN401 (buffers and textures)
            found = original(item, *given, **named)
            self._held[id(item), given, *named.items()] = found
            return found

        return call

    @contextmanager
    def without_gpu(self) -> Iterator[None]:
        """Leaves out dispatches, draws, clears, copies on the GPU, mip levels, barriers and timer queries.

        Reads return what was remembered, else zeros.
        """
        left_out = (*DISPATCHES, *DRAWS, *CLEARS, *COPIES, *MIPMAPS, *READS_INTO, *WAITS)
        idle = [(owner, name, _idle) for owner, name in left_out]
        reads = [(owner, name, self._recalling) for owner, name in BYTE_READS]
        untimed = (moderngl.Query, "elapsed", lambda _: property(lambda _: 0))
        uploads = [(owner, name, _uploading) for owner, name in TEXTURE_WRITES]
        with wrapped([*idle, *uploads, *reads, untimed]):
            yield

    def _recalling(self, original: Callable[..., bytes]) -> Callable[..., bytes]:
        @wraps(original)
        def call(item: Any, *given: int, **named: int) -> bytes:  # noqa: ANN401 (buffers and textures)
            size = given[0] if given and isinstance(item, moderngl.Buffer) else sizes_bytes([item])[0]
            held = self._held.get((id(item), given, *named.items()), b"")
            return held if len(held) == size else bytes(size)

        return call


def _idle(original: Callable[..., Any]) -> Callable[..., None]:
    """Does nothing in place of a method that returns nothing."""

    @wraps(original)
    def call(*_: object, **__: object) -> None:
        pass

    return call


def _uploading(original: Callable[..., Any]) -> Callable[..., None]:
    """Writes what the CPU has; from a buffer, the GPU copies."""

    @wraps(original)
    def call(texture: Any, data: Any, *given: Any, **named: Any) -> None:  # noqa: ANN401 (as the wrapped method)
        if not isinstance(data, moderngl.Buffer):
            original(texture, data, *given, **named)

    return call
