"""The steps of `deltalight gpu-check`; each runs in a process of its own and keeps what it finds as it goes along."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.gpu_check.record import Findings, Skipped
from protocol.errors import DeltalightError

if TYPE_CHECKING:
    from render_server.gpu.context import GpuContext
    from render_server.renderer import SceneRenderer

METHODS = ("exact", "paper", "dlpv", "differential", "dlpv-paper", "none", "aroof")
"""As for `demo --method`; the one that computes longest before its first frame comes last."""
NEEDLESS_CHECKS = ("packages [api]",)  # of doctor: what rendering does without
SIZES = {"640x480, 64^3": ((640, 480), 64), "1280x720, 256^3": ((1280, 720), 256)}
SPEED_FRAMES = 30  # the demo's recording; its camera moves in the last ten
LEAK_ROUNDS = 3
LEAK_FRAMES = 4


@contextmanager
def _context() -> "Iterator[GpuContext]":
    from render_server.gpu.context import create_context

    gpu = create_context()
    try:
        yield gpu
    finally:
        gpu.release()


def machine(findings: Findings) -> str:
    """Say what renders here: GL_RENDERER, GL_VENDOR, and GL_VERSION, which names the driver after the first space."""
    with _context() as gpu:
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
    """Examine the machine as `deltalight doctor` does."""
    from services.doctor import examine

    checks: list[dict[str, str]] = []
    for check in examine():
        checks.append(check.as_dict())
        findings.keep(checks=checks)
        if check.state == "missing" and check.name not in NEEDLESS_CHECKS:
            findings.fault(f"{check.name}: {check.detail}")
    return f"{len(checks)} checks"


def shaders(findings: Findings) -> str:
    """Let the driver compile every variant of every shader; a refusal leaves out the rest of that scene."""
    from benchmarks.gpu_check.beside_tests import shader_parts

    parts, labels = shader_parts(), list[str]()
    with _context() as gpu:
        gpu.compile_watchers.append(lambda label, _sources: labels.append(label))
        for name, compile_part in parts.items():
            try:
                compile_part(gpu, findings.scratch)
            except Exception as refusal:  # moderngl raises its own Error, with the driver's words
                findings.fault(f"{name}, {labels[-1] if labels else 'before the first shader'}: {refusal}")
            variants = sorted(set(labels))
            findings.keep(f"{len(variants)} shader variants so far", variants=variants)
    return f"{len(variants)} shader variants compiled by the driver"


def pictures(findings: Findings) -> str:
    """Compare the protected pictures with their goldens; those that differ go into `failed_pictures.png`."""
    from benchmarks.gpu_check.beside_tests import protected_pictures
    from benchmarks.gpu_check.failed_pictures import FailedPictures

    shown, found = FailedPictures(findings.out), dict[str, float | None]()
    with _context() as gpu:
        for one in protected_pictures(gpu, findings.scratch):
            found[one.name] = None if one.psnr_db == float("inf") else one.psnr_db
            if not one.is_alike:
                shown.add(one)
                findings.fault(f"{one.name}: {one.complaint}")
            findings.keep(f"{len(found)} pictures compared so far", psnr_db=found)
    alike = len(found) - len(findings.record.faults)
    return f"{alike} of {len(found)} pictures agree with their goldens"


def speed(findings: Findings) -> str:
    """Time every method at each of SIZES, with its stages, in milliseconds."""
    from benchmarks.gpu_check.timing import time_method

    timed: dict[str, dict[str, Any]] = {}
    for title, (size, volume) in SIZES.items():
        for method in METHODS:
            try:
                timing = time_method(method, SPEED_FRAMES, size, volume)
            except DeltalightError as fault:
                findings.fault(f"{method} at {title}: {fault}")
                continue
            timed.setdefault(title, {})[method] = asdict(timing)
            findings.keep(f"{method} at {title} was the last", timed=timed)
    return f"{sum(map(len, timed.values()))} measurements"


def memory(findings: Findings) -> str:
    """Say what each method's frame holds: bytes of each source and stage (`deltalight graph`), and GL objects."""
    from benchmarks.gpu_check.gl_objects import count_gl_objects

    held: dict[str, dict[str, Any]] = {}
    with _context() as gpu:
        for method in METHODS:
            before = sum(count_gl_objects().values())
            renderer = _rendered(gpu, method, findings.scratch)
            graph = renderer.graph
            assert graph is not None
            sizes = {source.name: source.size_bytes for source in graph.report_sources()}
            sizes |= {stage.name: stage.size_bytes for stage in graph.report()}
            objects = sum(count_gl_objects().values()) - before
            held[method] = {"total_bytes": sum(sizes.values()), "gl_objects": objects, "bytes": sizes}
            renderer.release()
            findings.keep(f"{method} was the last", held=held)
    return f"memory of {len(held)} methods"


def leaks(findings: Findings) -> str:
    """Create, use and release a renderer of each method again and again: the number of GL objects stays the same."""
    from benchmarks.gpu_check.gl_objects import count_gl_objects

    counts: dict[str, list[dict[str, int]]] = {}
    with _context() as gpu:
        for method in METHODS:
            rounds = counts.setdefault(method, [])
            for _ in range(LEAK_ROUNDS):
                _rendered(gpu, method, findings.scratch).release()
                rounds.append(count_gl_objects())
            findings.keep(f"{method} was the last", counts=counts)
            # The first round also makes what the context keeps for everybody.
            if any(each != rounds[0] for each in rounds[1:]):
                findings.fault(
                    f"{method}: {_grown(rounds[0], rounds[-1])} after {LEAK_ROUNDS - 1} more renderers"
                )
    return f"{LEAK_ROUNDS} renderers of each of {len(counts)} methods released"


def tests(findings: Findings) -> str:
    """Run the renderer's tests, slow ones last, where pytest is installed."""
    from benchmarks.gpu_check.beside_tests import require_tests

    require_tests()
    if find_spec("pytest") is None:
        raise Skipped("pytest is not installed")
    from benchmarks.gpu_check.gpu_tests import run_tests

    return run_tests(findings)


def quality(findings: Findings) -> str:  # noqa: ARG001
    """Leave the comparison with truth to machines that can render truth: none is part of the project."""
    raise Skipped("no truth beside this machine; `deltalight bench quality` renders it with Mitsuba")


def _rendered(gpu: "GpuContext", method: str, folder: Path) -> "SceneRenderer":
    """Return a renderer after some frames of a given model, during which the camera turns."""
    from render_server.renderer import SceneRenderer
    from services.frame_account import room_scene, turned_frame

    renderer = SceneRenderer(gpu, room_scene(method, folder))
    for number in range(LEAK_FRAMES):
        renderer.render(turned_frame(number, float(number % 2)))
    return renderer


def _grown(first: dict[str, int], last: dict[str, int]) -> str:
    changes = {kind: last[kind] - first[kind] for kind in first}
    return ", ".join(f"{change:+d} {kind}" for kind, change in changes.items() if change)
