"""Buffers and volumes set to zero on the GPU."""

from collections.abc import Sequence

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, common_kernel

CLEARING_GROUPS = 4096  # of workgroups at most; they stride over larger buffers
WORD_BYTES = 4
SHORT_BYTES = 16  # of headers of lists
CLEARED = ("Cleared", *(f"Cleared{number}" for number in range(1, 8)))  # as many as any GPU binds
NOTHING: Bindings = dict.fromkeys(CLEARED)
Start = tuple[moderngl.Buffer, int]
"""A buffer, and how many of its first bytes are meant (a multiple of 4)."""


def clear_buffer(gpu: GpuContext, buffer: moderngl.Buffer, size: int | None = None) -> None:
    """Sets the first `size` bytes (a multiple of 4; default: all) of a buffer to zero."""
    clear_buffers(gpu, (buffer, buffer.size if size is None else size))


def clear_buffers(gpu: GpuContext, *starts: Start) -> None:
    """Sets the starts of one to eight buffers to zero, in one dispatch; none if that was done before.

    Done before: by `clear_ahead`, or by a kernel (`note_cleared`).

    By a kernel: `Buffer.clear` maps the buffer, so it waits for the GPU; with glClearBufferSubData, an H200 took 9 ms
    longer for a frame of 256^3 voxels. In software, clearing is no more than a memset, 15 to 50 times as fast as a
    kernel (measured from 4 to 64 MB).
    """
    if gpu.is_software:
        for buffer, size in starts:
            if size <= SHORT_BYTES:
                gpu.clear_start(buffer, size)
            else:
                buffer.clear(size)
        return
    for buffer, _ in starts:
        gpu.used_up.pop(buffer, None)
    dirty = [(buffer, size) for buffer, size in starts if gpu.cleared_ahead.pop(buffer, 0) < size]
    if dirty:
        _clear(gpu, dirty)


def clear_for_later(gpu: GpuContext, *starts: Start) -> None:
    """Clears, in one dispatch on a GPU, what other stages of the frame fill: their own `clear_buffers` then need not.

    Nothing in software, where they clear as fast by themselves.
    """
    if not gpu.is_software:
        clear_buffers(gpu, *starts)
        note_cleared(gpu, *starts)


def clear_ahead(gpu: GpuContext, *starts: Start) -> None:
    """Lets buffers whose contents have been used up be cleared when the next frame begins, by its first kernel.

    Whoever fills one next calls `clear_buffers` all the same.
    """
    if not gpu.is_software:
        gpu.used_up.update(starts)


def note_cleared(gpu: GpuContext, *starts: Start) -> None:
    """Notes what a kernel that had other work there has just cleared on a GPU: the next `clear_buffers` need not."""
    if not gpu.is_software:
        gpu.cleared_ahead.update(starts)


def take_used_up(gpu: GpuContext) -> dict[str, Binding]:
    """Returns what a frame's first kernel clears by the way (shaders/common/cleared_starts.glsl).

    That is what `clear_ahead` was told of; more than eight buffers take dispatches of their own.
    """
    starts = [
        (buffer, size)
        for buffer, size in gpu.used_up.items()
        if not isinstance(buffer.mglo, moderngl.InvalidObject)
    ]
    gpu.used_up.clear()
    for first in range(len(CLEARED), len(starts), len(CLEARED)):
        _clear(gpu, starts[first : first + len(CLEARED)])
    gpu.cleared_ahead.update(starts)
    return cleared_starts(starts[: len(CLEARED)])


def cleared_starts(starts: Sequence[Start] = ()) -> dict[str, Binding]:
    """Returns the bindings of shaders/common/cleared_starts.glsl for up to eight buffers."""
    words = [size // WORD_BYTES for _, size in starts]
    counts = (*words, *[0] * len(CLEARED))[: len(CLEARED)]
    return {
        **NOTHING,
        **dict(zip(CLEARED, (buffer for buffer, _ in starts), strict=False)),
        "word_counts": counts[:4],
        "more_word_counts": counts[4:],
    }


def _clear(gpu: GpuContext, starts: Sequence[Start]) -> None:
    kernel = common_kernel(gpu, "clear_buffer")
    words = max(size // WORD_BYTES for _, size in starts)
    kernel.run((min(words, CLEARING_GROUPS * kernel.local_size[0]),), cleared_starts(starts))


def clear_volume(gpu: GpuContext, texture: moderngl.Texture3D) -> None:
    """Sets all texels to zero, without a copy of them on the CPU."""
    common_kernel(gpu, "clear_volume").run(texture.size, cleared=texture)
