"""Programs: a compute shader with its dispatch helper, and a raster program."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.shader_source import shader_source

SOFTWARE_WALKERS = 1024
# Mesa's software renderer ends all loops of a thread after 65535 turns in sum, without a word; tracing the cones of
# one texel takes up to about 5000 (16 cones through 256 voxels and the coarse scene).
SOFTWARE_SHARE = 12
LIST_WALKERS = 16384

Uniform = float | int | bool | Sequence[float] | Sequence[int] | np.ndarray[Any, Any]


def set_uniforms(program: moderngl.Program | moderngl.ComputeShader, uniforms: Mapping[str, Uniform]) -> None:
    """Write uniforms by name; one that the compiler removed is skipped. 4x4 arrays are row-major here."""
    for name, value in uniforms.items():
        member: Any = program.get(name, None)
        if member is None:
            continue
        if isinstance(value, np.ndarray):
            matrix = value.ndim == 2
            member.write(np.ascontiguousarray(value.T if matrix else value, dtype="f4").tobytes())
        else:
            member.value = value


class ComputeProgram:
    """A compute shader beside the pass that uses it.

    The one place where work is dispatched, so that the memory barrier is never forgotten: a missing
    barrier does not show on a software renderer.
    """

    def __init__(
        self, gpu: GpuContext, path: Path, defines: Mapping[str, int | float | str] | None = None
    ) -> None:
        self._ctx = gpu.ctx
        self._shader = gpu.ctx.compute_shader(shader_source(path, defines))
        self._local = _local_size(path)

    def run(self, threads: Sequence[int], **uniforms: Uniform) -> None:
        """Run at least `threads` (x[, y[, z]]) invocations, then wait for their writes to be visible."""
        set_uniforms(self._shader, uniforms)
        counts = [*threads, 1, 1][:3]
        groups = [max(1, -(-count // size)) for count, size in zip(counts, self._local, strict=True)]
        self._shader.run(*groups)
        self._ctx.memory_barrier()

    def release(self) -> None:
        """Free the GL object."""
        self._shader.release()


def list_threads(gpu: GpuContext, longest: int = LIST_WALKERS) -> int:
    """Threads to walk a list whose length only the GPU knows: at most `longest`; few in software, where an idle one
    costs as much as a busy one, but never so few that a thread's loops are cut off.
    """
    if not gpu.is_software:
        return longest
    return min(longest, max(SOFTWARE_WALKERS, -(-longest // SOFTWARE_SHARE)))


def _local_size(path: Path) -> tuple[int, int, int]:
    """Workgroup size that the shader at `path` declares."""
    line = next(text for text in path.read_text().splitlines() if "local_size_x" in text)
    sizes = dict(
        part.strip().split("=")
        for part in line[line.index("(") + 1 : line.index(")")].replace(" ", "").split(",")
    )
    return int(sizes["local_size_x"]), int(sizes.get("local_size_y", 1)), int(sizes.get("local_size_z", 1))


def raster_program(
    gpu: GpuContext, stem: Path, defines: Mapping[str, int | float | str] | None = None
) -> moderngl.Program:
    """Program from `stem.vert.glsl` and `stem.frag.glsl`."""
    return gpu.ctx.program(
        vertex_shader=shader_source(stem.with_suffix(".vert.glsl"), defines),
        fragment_shader=shader_source(stem.with_suffix(".frag.glsl"), defines),
    )
