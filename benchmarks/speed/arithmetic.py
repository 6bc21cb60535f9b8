"""The arithmetic that shaders execute, by stage of the graph: all programs are linked from shaders that count."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

import moderngl
import numpy as np

from deltalight.benchmarks.speed.counting_shaders import BLOCK, counting_source, require_tools
from deltalight.benchmarks.speed.flop_weights import NOTHING, Cost
from deltalight.benchmarks.speed.instruments import Wrapped, wrapped
from deltalight.render_server.gpu.timers import PassTimers

STAGES = {"vertex_shader": "vert", "fragment_shader": "frag"}
"""Arguments of `moderngl.Context.program`, and what tools call these stages."""


class ArithmeticCounter:
    """What shaders executed since `reset`, and by stage since `take_stages`."""

    def __init__(self) -> None:
        self._sums: dict[int, moderngl.Buffer] = {}  # by the context's id
        self._stages: dict[str, Cost] = {}

    def wraps(self) -> list[Wrapped]:
        """What is replaced while it counts."""
        return [
            (moderngl.Context, "compute_shader", self._linking_compute),
            (moderngl.Context, "program", self._linking_raster),
            (PassTimers, "measure", self._counting_stage),
        ]

    def take_stages(self) -> dict[str, Cost]:
        """Returns what each timed stage has executed since the last call."""
        stages, self._stages = self._stages, {}
        return stages

    def reset(self) -> None:
        """Begins anew."""
        for buffer in self._sums.values():
            buffer.write(bytes(16))

    def total(self) -> Cost:
        """Returns what all programs have executed since `reset`; waits for the GPU."""
        found = NOTHING
        for buffer in self._sums.values():
            buffer.ctx.memory_barrier()
            low_flops, high_flops, low_special, high_special = np.frombuffer(buffer.read(), "u4").tolist()
            found += Cost((high_flops << 32) + low_flops, (high_special << 32) + low_special)
        return found

    def _linking_compute(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def call(ctx: moderngl.Context, source: str) -> Any:  # noqa: ANN401 (as the wrapped method)
            return self._adopted(ctx, original(ctx, counting_source("comp", source)))

        return call

    def _linking_raster(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def call(ctx: moderngl.Context, **sources: str) -> Any:  # noqa: ANN401 (as the wrapped method)
            counting = {name: counting_source(STAGES[name], source) for name, source in sources.items()}
            return self._adopted(ctx, original(ctx, **counting))

        return call

    def _adopted(self, ctx: moderngl.Context, program: Any) -> Any:  # noqa: ANN401 (either kind)
        """Returns the program with the buffer of sums at a place that kernels leave alone, unseen by them."""
        place = ctx.info["GL_MAX_SHADER_STORAGE_BUFFER_BINDINGS"] - 1
        program._members.pop(BLOCK).binding = place
        if id(ctx) not in self._sums:
            self._sums[id(ctx)] = ctx.buffer(bytes(16))
            self._sums[id(ctx)].bind_to_storage_buffer(place)
        return program

    def _counting_stage(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        @contextmanager
        def call(timers: PassTimers, name: str) -> Iterator[None]:
            self.reset()
            with original(timers, name):
                yield
            self._stages[name] = self._stages.get(name, NOTHING) + self.total()

        return call


@contextmanager
def counted_arithmetic() -> Iterator[ArithmeticCounter]:
    """Counts what shaders execute that are linked inside, which takes them several times as long.

    Make the OpenGL context inside: programs that a context has already do not count.

    Raises:
        DeltalightError: a tool is missing, or refuses a shader.
    """
    require_tools()
    counter = ArithmeticCounter()
    with wrapped(counter.wraps()):
        yield counter
