"""The machine's measured peaks, and what a stage must at least take by them (a roofline's memory side)."""

from collections.abc import Callable
from pathlib import Path

from deltalight.benchmarks.speed.report import Peaks
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.textures import gpu_objects, release_all, sizes_bytes
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.graph import Graph
from deltalight.render_server.graph_report import StageReport

SHADERS = Path(__file__).parent / "shaders"
RUNS = 5  # the fastest counts: whatever disturbs a run makes it slower
COPIED_BYTES = 1 << 26
"""Above the caches of most machines, below the 128 MiB that a software renderer binds at once."""
THREADS, SOFTWARE_THREADS = 1 << 20, 1 << 14
ROUNDS = 1024
FLOPS_OF_ROUND = 32
"""Four chains of four components, a product and a sum each."""


def measure_peaks(gpu: GpuContext) -> Peaks:
    """Measures bandwidth by copying a large buffer, arithmetic by a loop of products and sums."""
    return Peaks(bytes_per_s=_bandwidth(gpu), flops_per_s=_arithmetic(gpu))


def _bandwidth(gpu: GpuContext) -> float:
    """Returns bytes a second, read and written ones together."""
    source, target = (gpu.ctx.buffer(reserve=COPIED_BYTES) for _ in range(2))
    kernel = Kernel(gpu, SHADERS / "copy")
    best_s = _fastest_s(gpu, lambda: kernel.run((COPIED_BYTES // 16,), Source=source, Target=target))
    release_all(kernel, source, target)
    return 2 * COPIED_BYTES / best_s


def _arithmetic(gpu: GpuContext) -> float:
    """Returns single-precision operations a second; a product and a sum are two."""
    threads = SOFTWARE_THREADS if gpu.is_software else THREADS
    result = gpu.ctx.buffer(reserve=4 * threads)
    kernel = Kernel(gpu, SHADERS / "multiply_add", ROUNDS=ROUNDS)
    best_s = _fastest_s(gpu, lambda: kernel.run((threads,), Result=result, factor=0.5))
    release_all(kernel, result)
    return threads * ROUNDS * FLOPS_OF_ROUND / best_s


def _fastest_s(gpu: GpuContext, work: Callable[[], None]) -> float:
    """Returns the shortest time of some runs after one that warms up, on the clock that times the stages."""
    timers = PassTimers(gpu)
    work()
    times_ms = []
    for _ in range(RUNS):
        with timers.measure("peak"):
            work()
        timers.end_frame()
        timers.wait()
        times_ms.append(timers.times_ms["peak"])
    return min(times_ms) / 1000


def stage_bytes(graph: Graph) -> dict[str, int]:
    """Returns for each stage that ever ran the bytes that its resources hold, each once, without mip levels."""
    stages = [stage for stage in graph.report() if not stage.is_value]
    return {stage.name: _bytes_of(graph, stage) for stage in stages if _has_run(graph, stage)}


def _has_run(graph: Graph, stage: StageReport) -> bool:
    """Whether anything needed the stage: image-based shading leaves out a method's own shading."""
    return all(graph.resource(name).version > 0 for name in stage.outputs)


def _bytes_of(graph: Graph, stage: StageReport) -> int:
    names = (*stage.inputs, *stage.outputs)
    held = {id(item): item for name in names for item in gpu_objects(graph[name])}
    return sizes_bytes([tuple(held.values())])[0]
