"""Rendering speed of the demo on this machine: each pass, and camera to viewer through all processes."""

import os
import statistics
import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from protocol.frames import ViewFrame
from protocol.scene import SceneDocument
from protocol.scene_method import VoxelConeSettings
from protocol.source import open_source
from render_server.gpu.context import create_context
from render_server.renderer import SceneRenderer
from sensor_node.view_frames import ViewFrameBuilder
from services.demo import RECORDING, collect_composites, demo_scene
from services.offline import with_output

CHANGE_PASS = "direct light"  # every method runs it, and only if camera, real scene or objects moved
WARM_UP_FRAMES = 3  # drivers compile and specialise shaders in the first frames


def measure_speed(
    methods: Sequence[str],
    frames: int,
    *,
    size: tuple[int, int] | None,
    device: int | None,
    end_to_end: bool,
    volume: int | None = None,
) -> dict[str, Any]:
    """Measure every method; times in milliseconds, medians over `frames` frames.

    `volume`: voxels an edge, default as the machine can; methods that have other cells keep theirs.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a process that died for good.
    """
    scenes = {method: _with_volume(with_output(demo_scene(method), size, None), volume) for method in methods}
    source = open_source(RECORDING)
    builder = ViewFrameBuilder(source)
    views = [builder(source[index % len(source)]) for index in range(WARM_UP_FRAMES + frames)]
    gpu = create_context(device)
    report: dict[str, Any] = {
        "renderer": gpu.renderer_name,
        "cpus": os.cpu_count(),
        "size": list(size or (source.camera.width, source.camera.height)),
        "frames": frames,
        "methods": {},
    }
    try:
        for method, scene in scenes.items():
            renderer = SceneRenderer(gpu, scene)
            report["methods"][method] = _measure(renderer, views)
            renderer.release()
    finally:
        gpu.release()
    if end_to_end:
        for method, scene in scenes.items():
            report["methods"][method]["end_to_end"] = _measure_end_to_end(scene, frames)
    return report


def _with_volume(scene: SceneDocument, volume: int | None) -> SceneDocument:
    if volume is None or not isinstance(scene.method, VoxelConeSettings):
        return scene
    return scene.replaced(method=scene.method.replaced(volume_size=volume))


def _measure(renderer: SceneRenderer, views: Sequence[ViewFrame]) -> dict[str, Any]:
    passes: dict[str, list[float]] = {}
    frame_ms: list[float] = []
    moving_ms: list[float] = []
    still_ms: list[float] = []
    for index, view in enumerate(views):
        started_s = time.perf_counter()
        composite = renderer.render(view)
        elapsed_ms = 1000 * (time.perf_counter() - started_s)
        if index < WARM_UP_FRAMES:
            continue
        frame_ms.append(elapsed_ms)
        (moving_ms if CHANGE_PASS in composite.pass_times_ms else still_ms).append(elapsed_ms)
        for name, milliseconds in composite.pass_times_ms.items():
            passes.setdefault(name, []).append(milliseconds)
    median_ms = statistics.median(frame_ms)
    return {
        # A pass whose result is still valid does not run: its median is over the frames in which it ran.
        "passes": {
            name: {
                "median_ms": statistics.median(values),
                "runs": len(values) / len(frame_ms),
                "share": sum(values) / sum(frame_ms),
            }
            for name, values in passes.items()
        },
        "frame_ms": median_ms,
        "frames_per_s": 1000 * len(frame_ms) / sum(frame_ms),
        "still_frame_ms": statistics.median(still_ms) if still_ms else None,
        "moving_frame_ms": statistics.median(moving_ms) if moving_ms else None,
        "notices": list(renderer.notices),
    }


def _measure_end_to_end(scene: SceneDocument, frames: int) -> dict[str, Any]:
    summary = collect_composites(scene, WARM_UP_FRAMES + frames, None)
    return {key: summary[key] for key in ("frames_per_s", "age_median_ms", "age_p95_ms", "drops")}


def print_report(report: dict[str, Any]) -> None:
    """Print the report as tables: one row per pass, one column pair per method."""

    console = Console()
    width, height = report["size"]
    console.print(f"{report['renderer']}, {report['cpus']} CPUs, {width}x{height}, {report['frames']} frames")
    for method, figures in report["methods"].items():
        _print_method(console, method, figures)


def _print_method(console: Console, method: str, figures: dict[str, Any]) -> None:

    table = Table("Pass", "median ms", "runs in", "share of time", title=method, title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, one in figures["passes"].items():
        table.add_row(name, f"{one['median_ms']:.2f}", f"{one['runs']:.0%}", f"{one['share']:.0%}")
    console.print(table)
    console.print(f"all frames of the recording: {figures['frames_per_s']:.1f} frames/s")
    for key, meaning in (("still_frame_ms", "nothing moves"), ("moving_frame_ms", "the camera moves")):
        if figures[key] is not None:
            console.print(f"frame while {meaning}: {figures[key]:.1f} ms")
    for notice in figures["notices"]:  # among them the memory of the volumes
        console.print(notice)
    through = figures.get("end_to_end")
    if through is not None:
        console.print(
            f"camera to viewer through all processes: {through['frames_per_s']:.1f} frames/s,"
            f" age {through['age_median_ms']:.0f} ms (p95 {through['age_p95_ms']:.0f} ms)"
        )
