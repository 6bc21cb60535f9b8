"""Stages write what they declare, and nothing that another stage made: the graph checks it, kernel by kernel.

Here in small; test_protected_pictures.py has it checked while every method renders.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu import kernel as kernel_module
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.graph import Graph, GraphError

pytestmark = pytest.mark.usefixtures("clean_gl")
COPY = """
layout(local_size_x = 1) in;
layout(std430) readonly buffer From { int from[]; };
layout(std430) buffer To { int to[]; };
void main() { to[gl_GlobalInvocationID.x] = from[gl_GlobalInvocationID.x] + 1; }
"""


@pytest.fixture
def copy(gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Kernel:
    """A kernel that writes `From` + 1 into `To`."""
    (tmp_path / "copy.comp.glsl").write_text(COPY)
    monkeypatch.setattr(kernel_module, "SHADERS", tmp_path)
    return Kernel(gpu, "copy")


def buffers(gpu: GpuContext, count: int) -> list[moderngl.Buffer]:
    return [gpu.ctx.buffer(np.arange(4, dtype=np.int32).tobytes()) for _ in range(count)]


def content(buffer: moderngl.Buffer) -> list[int]:
    return list(np.frombuffer(buffer.read(), np.int32))


def test_a_kernel_may_write_what_its_stage_returns_and_what_nobody_has(gpu: GpuContext, copy: Kernel) -> None:
    given, made, unknown = buffers(gpu, 3)
    graph = Graph(gpu, checks=True)
    source = graph.source("source", "view")

    def fill(value: moderngl.Buffer) -> moderngl.Buffer:
        copy.run((4,), From=value, To=unknown)
        copy.run((4,), From=unknown, To=made)
        return made

    graph.stage("fill", fill, source)
    for count in (1, 2):
        source.write(given)
        graph.run()
        assert graph.resource("fill").version == count
    assert content(made) == [2, 3, 4, 5]
    assert gpu.watchers == []


class Holder:
    """As a pass holds its textures: an attribute."""

    __module__ = "deltalight.render_server.passes.example"

    def __init__(self, buffer: moderngl.Buffer) -> None:
        self.buffer = buffer


@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: {"Name": x}, lambda x: (0, x), Holder])
def test_a_kernel_may_not_write_what_another_stage_made(
    gpu: GpuContext, copy: Kernel, wrap: Callable[[moderngl.Buffer], Any]
) -> None:
    first, second = buffers(gpu, 2)
    graph = Graph(gpu, checks=True)
    graph.stage("fields", lambda: wrap(first))

    def spoil(_fields: object) -> moderngl.Buffer:
        copy.run((4,), From=second, To=first)
        return second

    graph.stage("composite", spoil, "fields")
    with pytest.raises(
        GraphError, match=r"Stage `composite` writes `fields` \(kernel copy, `To`\), .*not declare"
    ):
        graph.run()
    assert graph.resource("composite").version == 0
    assert gpu.watchers == []


def test_a_kernel_may_not_write_a_source(gpu: GpuContext, copy: Kernel) -> None:
    first, second = buffers(gpu, 2)
    graph = Graph(gpu, checks=True)
    source = graph.source("picture", "view")
    source.write(first)

    def spoil(picture: moderngl.Buffer) -> moderngl.Buffer:
        copy.run((4,), From=second, To=picture)
        return second

    graph.stage("edges", spoil, source)
    with pytest.raises(GraphError, match="Stage `edges` writes `picture`"):
        graph.run()


def test_a_stage_may_change_what_it_hands_on(gpu: GpuContext, copy: Kernel) -> None:
    """From the first run on; also what it hands on beside its result."""
    first, second, third = buffers(gpu, 3)
    graph = Graph(gpu, checks=True)
    graph.stages("made", lambda: (first, second), outputs=("first", "second"))

    def change(one: moderngl.Buffer, two: moderngl.Buffer) -> tuple[moderngl.Buffer, Holder]:
        copy.run((4,), From=one, To=third)
        copy.run((4,), From=third, To=two)
        return third, Holder(two)

    graph.stages("change", change, "first", "second", outputs=("changed", "changed second"))
    graph.run()
    assert content(second) == [2, 3, 4, 5]


def test_reading_what_another_stage_made_is_no_offence(gpu: GpuContext, copy: Kernel) -> None:
    first, second = buffers(gpu, 2)
    graph = Graph(gpu, checks=True)
    graph.stage("made", lambda: first)

    def read(made: moderngl.Buffer) -> moderngl.Buffer:
        copy.run((4,), From=made, To=second)
        return second

    graph.stage("read", read, "made")
    graph.run()
    assert content(second) == [1, 2, 3, 4]


def test_without_checks_nothing_is_watched(gpu: GpuContext, copy: Kernel) -> None:
    first, second = buffers(gpu, 2)
    graph = Graph(gpu)
    graph.stage("made", lambda: first)

    def spoil(made: moderngl.Buffer) -> int:
        assert gpu.watchers == []
        copy.run((4,), From=second, To=made)
        return 0

    graph.stage("spoil", spoil, "made")
    graph.run()
