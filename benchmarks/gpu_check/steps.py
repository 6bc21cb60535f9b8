"""The steps of `deltalight gpu-check`; each runs in a process of its own and keeps what it finds as it goes along."""

import gc
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import TYPE_CHECKING, Any

from deltalight.benchmarks.gpu_check.processes import opened_context, usable_cores
from deltalight.benchmarks.gpu_check.record import Findings, Skipped, fault_sentence

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext
    from deltalight.render_server.renderer import SceneRenderer

METHODS = ("exact", "paper", "dlpv", "differential", "dlpv-paper", "aroof")
"""As for `demo --method`; the one that computes longest before its first frame comes last.

`none` is left out: it draws the objects as `exact` does, so each of its stages runs, and leaves its light on the real
scene out of the composition.
"""
RATED = METHODS[:-1]  # `aroof` would compute longest before its picture
NEEDLESS_CHECKS = ("packages to serve",)  # of doctor: what rendering does without
SIZES = {"640x480, 64^3": ((640, 480), 64), "1280x720, 256^3": ((1280, 720), 256)}
SPEED_FRAMES = 12  # of each motion, after those that warm up
QUALITY_LOSS_DB = 1.0  # beside software, whose cones and shadow maps are coarser
LEAK_ROUNDS = 3
LEAK_FRAMES = 4


@contextmanager
def _noting(findings: Findings, what: str) -> Iterator[None]:
    """Notes what is raised inside, so that the step goes on with the next thing; `what` names this one."""
    try:
        yield
    except Exception as fault:  # moderngl raises its own Error, with the driver's words
        traceback.print_exc()
        findings.fault(f"{what}: {fault_sentence(fault)}")


def _processes() -> int:
    """Returns how many processes share a step's work: one in software, which fills the cores by itself."""
    with opened_context() as gpu:
        return 1 if gpu.is_software else usable_cores()


def machine(findings: Findings) -> str:
    """Says what renders here: GL_RENDERER, GL_VENDOR, GL_VERSION, which names the driver after the first space."""
    with opened_context() as gpu:
        version, _, driver = gpu.version.partition(" ")
        findings.keep(
            gpu=gpu.renderer_name,
            vendor=str(gpu.ctx.info["GL_VENDOR"]),
            gl_version=version,
            driver=driver,
            is_software=gpu.is_software,
        )
    return f"{gpu.renderer_name}, OpenGL {gpu.version}"


def doctor(findings: Findings) -> str:
    """Examines the machine as `deltalight doctor` does."""
    from deltalight.services.doctor import examine

    checks: list[dict[str, str]] = []
    for check in examine():
        checks.append(check.as_dict())
        findings.keep(checks=checks)
        if check.state == "missing" and check.name not in NEEDLESS_CHECKS:
            findings.fault(f"{check.name}: {check.detail}")
    return f"{len(checks)} checks"


def shaders(findings: Findings) -> str:
    """Lets the driver compile every variant of every shader."""
    from deltalight.benchmarks.gpu_check.compiling import compile_everything

    return compile_everything(findings, _processes())


def pictures(findings: Findings) -> str:
    """Compares the protected pictures with their goldens; those that differ go into `failed_pictures.png`."""
    from deltalight.benchmarks.gpu_check.picture_check import compare_pictures

    return compare_pictures(findings, _processes())


def speed(findings: Findings) -> str:
    """Times every method at each of SIZES, with its stages, in milliseconds."""
    from deltalight.benchmarks.gpu_check.timing import time_method

    timed: dict[str, dict[str, Any]] = {title: {} for title in SIZES}
    open_ = [(method, title) for method in METHODS for title in SIZES]
    while open_:
        method, title = open_.pop(0)
        with _noting(findings, f"{method} at {title}"):
            timed[title][method] = asdict(time_method(method, SPEED_FRAMES, *SIZES[title]))
        findings.keep(_not_yet(f"{at} at {of}" for at, of in open_), timed=timed)
    return f"{sum(map(len, timed.values()))} measurements"


def _not_yet(names: Iterable[str]) -> str:
    return f"not yet: {', '.join(names) or 'nothing'}"


def memory(findings: Findings) -> str:
    """Says what each method's frame holds: bytes of each source and stage (`deltalight graph`), and GL objects.

    `room_bytes` is what a room takes of the device's memory, whatever its method.
    """
    held: dict[str, dict[str, Any]] = {}
    with opened_context() as gpu:
        free_bytes = _free_bytes(gpu)
        for number, method in enumerate(METHODS, start=1):
            with _noting(findings, method):
                held[method] = _held(gpu, method, findings.scratch)
                room_bytes = _room_bytes(gpu, held, free_bytes)
                findings.keep(_not_yet(METHODS[number:]), held=held, room_bytes=room_bytes)
    return f"memory of {len(held)} methods"


def _free_bytes(gpu: "GpuContext") -> int | None:
    from deltalight.render_server.gpu.device_memory import device_memory, gl_integers

    return device_memory(gpu.ctx.extensions, gl_integers(), is_software=gpu.is_software)[1]


def _room_bytes(gpu: "GpuContext", held: dict[str, dict[str, Any]], free_bytes: int | None) -> int:
    """Returns the process's peak in software, else what is less free than `free_bytes`, or the largest frame."""
    if gpu.is_software:
        return getrusage(RUSAGE_SELF).ru_maxrss * 1024
    now, largest = _free_bytes(gpu), max(each["total_bytes"] for each in held.values())
    return int(largest if now is None or free_bytes is None else max(largest, free_bytes - now))


def _held(gpu: "GpuContext", method: str, folder: Path) -> dict[str, Any]:
    from deltalight.render_server.gpu.context import count_gl_objects

    before = sum(count_gl_objects().values())
    renderer = _rendered(gpu, method, folder)
    graph = renderer.graph
    assert graph is not None
    sizes = {source.name: source.size_bytes for source in graph.report_sources()}
    sizes |= {stage.name: stage.size_bytes for stage in graph.report()}
    objects = sum(count_gl_objects().values()) - before
    renderer.release()
    return {"total_bytes": sum(sizes.values()), "gl_objects": objects, "bytes": sizes}


def leaks(findings: Findings) -> str:
    """Creates, uses and releases a renderer of each method repeatedly: the number of GL objects stays the same."""
    counts: dict[str, list[dict[str, int]]] = {}
    with opened_context() as gpu:
        for number, method in enumerate(METHODS, start=1):
            with _noting(findings, method):
                counts[method] = list(_counts(gpu, method, findings.scratch))
                findings.keep(_not_yet(METHODS[number:]), counts=counts)
                first, *later = counts[method]  # the first also makes what the context keeps for everybody
                if any(each != first for each in later):
                    findings.fault(f"{method}: {_grown(first, later[-1])} after {len(later)} more renderers")
    return f"{LEAK_ROUNDS} renderers of each of {len(counts)} methods released"


def _counts(gpu: "GpuContext", method: str, folder: Path) -> Iterator[dict[str, int]]:
    from deltalight.render_server.gpu.context import count_gl_objects

    for _ in range(LEAK_ROUNDS):
        _rendered(gpu, method, folder).release()
        gc.collect()  # an earlier method may have failed in the middle
        gpu.check()
        yield count_gl_objects()


def tests(findings: Findings) -> str:
    """Runs the renderer's tests where pytest is installed, but for those marked `slow`."""
    return _tests(findings, "not slow")


def slow_tests(findings: Findings) -> str:
    """Runs those of the renderer's tests that are marked `slow`."""
    return _tests(findings, "slow")


def _tests(findings: Findings, marked: str) -> str:
    from deltalight.benchmarks.gpu_check.beside_tests import require_tests

    require_tests()
    if find_spec("pytest") is None:
        raise Skipped("pytest is not installed")
    from deltalight.benchmarks.gpu_check.gpu_tests import run_tests

    return run_tests(findings, marked)


def quality(findings: Findings) -> str:
    """Compares methods' pictures of a stored scene with path-traced truth, on what the objects change."""
    from deltalight.benchmarks.gpu_check.stored_truth import StoredTruth

    truth = StoredTruth.unpacked(findings.scratch / "truth")
    measured = dict[str, float]()
    with opened_context() as gpu:
        for number, method in enumerate(RATED, start=1):
            with _noting(findings, method):
                measured[method] = round(truth.psnr_db(gpu, method), 2)
                expected = truth.about["psnr_db"][method]
                if measured[method] < expected - QUALITY_LOSS_DB:
                    findings.fault(f"{method}: {measured[method]} dB, in software {expected}")
            findings.keep(_not_yet(RATED[number:]), changed_psnr_db=measured)
    return f"{truth.about['scene']}: " + ", ".join(f"{name} {db:.1f} dB" for name, db in measured.items())


def _rendered(gpu: "GpuContext", method: str, folder: Path) -> "SceneRenderer":
    """Returns a renderer after some frames of a given model, during which the camera turns."""
    from deltalight.render_server.renderer import SceneRenderer
    from deltalight.services.frame_account import room_scene, turned_frame

    renderer = SceneRenderer(gpu, room_scene(method, folder))
    for number in range(LEAK_FRAMES):
        renderer.render(turned_frame(number, float(number % 2)))
    return renderer


def _grown(first: dict[str, int], last: dict[str, int]) -> str:
    changes = {kind: last[kind] - first[kind] for kind in first}
    return ", ".join(f"{change:+d} {kind}" for kind, change in changes.items() if change)
