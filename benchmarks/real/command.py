"""`deltalight bench real` with parsed options."""

import json
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from deltalight.benchmarks.real import bins, cartons
from deltalight.benchmarks.real.report import as_data, tables, write_report
from deltalight.protocol.errors import DeltalightError
from deltalight.services.files import make_output_folder


def run_real(data: Path, out: Path, *, device: int | None, as_json: bool) -> None:
    """Measures both sets of photographs of a folder, writes the report into `out`, and prints it.

    Raises:
        DeltalightError: a folder or file is missing or wrong, `out` cannot be written, or there is no OpenGL.
    """
    for name in (cartons.FOLDER, bins.FOLDER):
        if not (data / name).is_dir():
            raise DeltalightError(
                f"{data} holds no folder {name}; name the folder of real pairs with --data."
            )
    make_output_folder(out)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        of_cartons = cartons.measure_cartons(data / cartons.FOLDER, progress, device)
        of_bins = bins.measure_bins(data / bins.FOLDER, progress, device)
    write_report(out, of_cartons, of_bins)
    if as_json:
        print(json.dumps(as_data(of_cartons, of_bins), indent=2))
    else:
        for table in tables(of_cartons, of_bins):
            table.print(Console())
    console.print(f"The report is {out / 'real.md'}", soft_wrap=True)
