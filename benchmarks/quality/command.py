"""`deltalight bench quality` with parsed options."""

import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from deltalight.benchmarks.ground_truth.scenes import SCENES, scene_named
from deltalight.benchmarks.quality.ablation import ablation_chain
from deltalight.benchmarks.quality.evaluate import QualityJob, measure_quality
from deltalight.benchmarks.quality.kept import KeptResults
from deltalight.benchmarks.quality.report import require_replaceable, write_report
from deltalight.benchmarks.quality.report_data import as_data
from deltalight.benchmarks.quality.tables import all_tables
from deltalight.benchmarks.variants import Variant, parse_variants
from deltalight.protocol.errors import DeltalightError


def run_quality(
    scenes: Sequence[str] | None,
    methods: str | None,
    size: tuple[int, int],
    spp: int,
    *,
    volume_size: int | None,
    device: int | None,
    out: Path,
    as_json: bool,
) -> None:
    """Measures, writes the report as folder `out`, and prints it; goes on where a run of the same inputs was cut off.

    `scenes` None = all; `methods` None = the ablation chain; `size` is width and height in pixels.

    Raises:
        DeltalightError: an unknown scene or method, `out` is something else, no OpenGL, or no truth.
    """
    chosen = SCENES if scenes is None else [scene_named(name.strip()) for name in scenes]
    variants = _ablation(volume_size) if methods is None else parse_variants(methods)
    require_replaceable(out)
    console, kept = Console(stderr=True), KeptResults.beside(out)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        result = measure_quality(QualityJob(chosen, variants, size, spp, volume_size, device), progress, kept)
    write_report(result, out)
    kept.remove()
    if as_json:
        print(json.dumps(as_data(result), indent=2))
    else:
        for table in all_tables(result):
            table.print(Console())
    if kept.taken:
        console.print(f"{kept.taken} results are from the run that was cut off.")
    console.print(f"The report is {out / 'index.html'}", soft_wrap=True)


def _ablation(volume_size: int | None) -> list[Variant]:
    if volume_size is not None:
        raise DeltalightError("--ablation chooses the voxels of each row itself; leave out --volume.")
    return ablation_chain()
