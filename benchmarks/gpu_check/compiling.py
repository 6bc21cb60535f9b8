"""Every shader variant through the driver's compiler, on all cores.

Scenes ask for their variants one after the other, many of them for the same ones. So the scenes are rendered without
compiling first, which tells the compute shaders; these are compiled, each once; then the scenes are rendered, with
what the driver kept on disk.
"""

import traceback
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import moderngl

from deltalight.benchmarks.gpu_check.beside_tests import shader_parts
from deltalight.benchmarks.gpu_check.processes import opened_context, process_context, spread
from deltalight.benchmarks.gpu_check.record import Findings, fault_sentence

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext

CHUNKS = 4  # of variants, for each process: the last ones to end are short
Variant = tuple[str, str]
"""A compute shader's label and text."""


class UncompiledShader(moderngl.ComputeShader):
    """Stands where nothing is compiled; its runs do nothing."""

    def __init__(self) -> None:
        pass

    def __del__(self) -> None:
        pass

    def __iter__(self) -> Generator[str, None, None]:
        """Names no resource."""
        yield from ()

    def run(self, group_x: int = 1, group_y: int = 1, group_z: int = 1) -> None:
        """Does nothing."""

    def run_indirect(self, buffer: moderngl.Buffer, offset: int = 0) -> None:
        """Does nothing."""

    def release(self) -> None:
        """Does nothing."""


def compile_everything(findings: Findings, processes: int) -> str:
    """Compiles every variant and renders every scene; notes what the driver refuses, and what was done when.

    One process leaves out what several need to share the work.
    """
    parts = list(shader_parts())
    if processes == 1:
        with opened_context() as gpu:
            return _note_parts(findings, (render_part(gpu, part) for part in parts), len(parts), set())
    known = _compile_known(findings, parts, processes)
    rendered = spread(render_part_here, parts, processes)
    found = (done.result or RenderedPart(done.item, (), f"{done.item}: {done.fault}") for done in rendered)
    return _note_parts(findings, found, len(parts), known)


def _compile_known(findings: Findings, parts: Sequence[str], processes: int) -> set[str]:
    """Compiles what the parts ask for, each variant once, and returns the labels."""
    known: dict[str, str] = {}
    for asked in spread(asked_variants, parts, processes):
        known |= asked.result or {}
    findings.done("variants are known")
    labels: set[str] = set()
    for done in spread(compile_variants, dealt(known, CHUNKS * processes), processes):
        chunk = [label for label, _ in done.item]
        labels.update(chunk)
        for fault in done.result or ():
            findings.fault(fault)
        if done.fault is not None:
            findings.fault(f"one of {', '.join(chunk)}: {done.fault}")
        said = f"{len(labels)} of {len(known)} shader variants compiled, no scene rendered"
        findings.keep(said, variants=sorted(labels))
    findings.done("variants are compiled")
    return labels


def _note_parts(
    findings: Findings, rendered: "Iterable[RenderedPart]", total: int, variants: set[str]
) -> str:
    for count, part in enumerate(rendered, start=1):
        variants.update(part.labels)
        if part.fault is not None:
            findings.fault(part.fault)
        said = f"{len(variants)} shader variants so far, {count} of {total} scenes rendered"
        findings.keep(said, variants=sorted(variants))
        findings.done(part.name)
    return f"{len(variants)} shader variants given to the driver"


def asked_variants(part: str) -> dict[str, str]:
    """Returns the compute shaders that a part asks for, by label. None is compiled, so its pictures are worthless."""
    found: dict[str, str] = {}

    def note(label: str, sources: Mapping[str, str]) -> None:
        if "comp" in sources:
            found[label] = sources["comp"]

    with opened_context() as gpu, TemporaryDirectory() as folder, suppress(Exception):
        gpu.compile_watchers.append(note)
        gpu.ctx.compute_shader = lambda source: UncompiledShader()  # type: ignore[method-assign] # noqa: ARG005
        shader_parts()[part](replace(gpu, compiles_unrun=True), Path(folder))
    return found


def dealt(found: Mapping[str, str], count: int) -> list[list[Variant]]:
    """Returns the variants as at most `count` lists of about the same length of text."""
    longest_first = sorted(found.items(), key=lambda variant: len(variant[1]), reverse=True)
    return [chunk for index in range(count) if (chunk := longest_first[index::count])]


def compile_variants(variants: list[Variant]) -> list[str]:
    """Compiles each; returns a sentence for each that the driver refuses."""
    gpu, faults = process_context(), []
    for label, source in variants:
        try:
            gpu.ctx.compute_shader(source).release()
        except Exception as fault:
            faults.append(f"{label}: {fault_sentence(fault)}")
    return faults


@dataclass(frozen=True)
class RenderedPart:
    """Labels of the variants that a part asked for, and what went wrong."""

    name: str
    labels: Sequence[str]
    fault: str | None = None


def render_part(gpu: "GpuContext", part: str) -> RenderedPart:
    """Renders a part; what is refused leaves out the rest of it."""
    labels: list[str] = []

    def note(label: str, _sources: Mapping[str, str]) -> None:
        labels.append(label)

    gpu.compile_watchers.append(note)
    try:
        with TemporaryDirectory() as folder:
            shader_parts()[part](replace(gpu, compiles_unrun=True), Path(folder))
    except Exception as fault:  # moderngl raises its own Error, with the driver's words
        traceback.print_exc()
        return RenderedPart(part, labels, f"{', '.join([part, *labels[-1:]])}: {fault_sentence(fault)}")
    finally:
        gpu.compile_watchers.remove(note)
    return RenderedPart(part, labels)


def render_part_here(part: str) -> RenderedPart:
    """Renders a part in this process's context."""
    return render_part(process_context(), part)
