"""What is counted of OpenGL's calls is exactly what was called, and what is left out leaves no trace."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.benchmarks.speed.instruments import GpuCounts, ReadBacks, counted
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.textures import AsyncReadback, release_target, texture_2d

FILL = """layout(local_size_x = 1) in;
layout(std430) writeonly buffer Out { float values[]; };
uniform float first;
uniform vec2 others;
void main() { values[0] = first; values[1] = others.x; values[2] = others.y; values[3] = 0.0; }
"""
CORNER = "#version 430\nvoid main() { gl_Position = vec4(gl_VertexID & 1, gl_VertexID >> 1, 0, 1); }"
WHITE = "#version 430\nout vec4 color; void main() { color = vec4(1); }"


@pytest.fixture
def fill(gpu: GpuContext, tmp_path: Path) -> Iterator[Kernel]:
    """Writes 4 floats: `first`, both of `others`, 0."""
    (tmp_path / "fill.comp.glsl").write_text(FILL)
    kernel = Kernel(gpu, tmp_path / "fill")
    yield kernel
    kernel.release()


@pytest.fixture
def out(gpu: GpuContext) -> Iterator[moderngl.Buffer]:
    buffer = gpu.ctx.buffer(reserve=16)
    yield buffer
    buffer.release()


def test_a_known_sequence_is_counted_exactly(gpu: GpuContext, fill: Kernel, out: moderngl.Buffer) -> None:
    plain: Any = gpu.ctx  # as elsewhere, without the tests' filling of new memory
    gpu = replace(gpu, ctx=plain.unfilled)
    texture = texture_2d(gpu, (4, 2), 4, "u1")
    target = gpu.ctx.framebuffer([texture])
    program = gpu.ctx.program(vertex_shader=CORNER, fragment_shader=WHITE)
    triangle = gpu.ctx.vertex_array(program, [])
    readback = AsyncReadback(gpu)
    fill.run((1,), Out=out, first=0.0, others=(0.0, 0.0))
    with counted() as counts:
        fill.run((1,), Out=out, first=1.0, others=(2.0, 3.0))
        fill.run((1,), Out=out, first=1.0, others=(2.0, 4.0))  # one of two uniforms is new
        target.use()
        target.clear()
        triangle.render(moderngl.TRIANGLES, vertices=3)
        out.clear()
        out.clear(size=4)
        out.write(np.zeros(2, np.float32))
        texture.write(bytes(32), alignment=1)
        made = gpu.ctx.buffer(bytes(100))
        empty = gpu.ctx.buffer(reserve=1000)
        other = texture_2d(gpu, (2, 2), 1, "f4", data=bytes(16))
        assert out.read() == bytes(16)
        texture.read(alignment=1)
        texture.read_into(empty, alignment=1)
        readback.push(texture, "u1")
        readback.pop()  # the picture's own are no reads amid a frame
    expected = GpuCounts(
        dispatches=2,
        draws=1,
        framebuffer_clears=1,
        buffer_clears=2,
        buffer_clear_bytes=16 + 4,
        uploads=4,
        uploaded_bytes=8 + 32 + 100 + 16,
        reads=3,
        uniform_writes=3,
    )
    assert counts == expected
    fill.run((1,), Out=out, first=5.0, others=(2.0, 4.0))
    out.clear()
    assert counts == expected, "nothing is counted afterwards"
    release_target(target)
    for item in (made, empty, other, readback, triangle, program, texture):
        item.release()


def test_members_are_put_back_even_after_an_error() -> None:
    before = dict(vars(moderngl.Buffer))

    def fail() -> None:
        with counted(), ReadBacks().without_gpu():
            assert vars(moderngl.Buffer)["clear"] is not before["clear"]
            raise RuntimeError("inside")

    with pytest.raises(RuntimeError, match="inside"):
        fail()
    assert dict(vars(moderngl.Buffer)) == before


def test_without_gpu_nothing_is_written_and_reads_return_what_was_read_last(
    gpu: GpuContext, fill: Kernel, out: moderngl.Buffer
) -> None:
    reads = ReadBacks()
    texture = texture_2d(gpu, (3, 1), 1, "u1", data=b"abc")
    unread = gpu.ctx.buffer(b"12345678")
    fill.run((1,), Out=out, first=1.0, others=(2.0, 3.0))
    with reads.remembered():
        held = out.read()
        assert out.read(4) == held[:4]
        assert texture.read(alignment=1) == b"abc"
    with reads.without_gpu():
        fill.run((1,), Out=out, first=7.0, others=(8.0, 9.0))
        out.clear()
        assert (out.read(), out.read(4)) == (held, held[:4])
        assert (texture.read(alignment=1), texture.read()) == (b"abc", bytes(3))
        assert (unread.read(), unread.read(4)) == (bytes(8), bytes(4))
    assert out.read() == held
    assert unread.read() == b"12345678"
    texture.release()
    unread.release()
