"""`deltalight graph`: the stages of a frame."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.method_names import require_method
from deltalight.services.commands.options import MethodName, writable

if TYPE_CHECKING:
    from deltalight.services.frame_account import FrameAccount

NARROWEST = 150  # columns of a table that no terminal shows


def graph(
    *,
    method: MethodName = "dvct",
    svg: Annotated[
        Path | None, typer.Option(callback=writable, metavar="FILE", help="Write the graph to an SVG file.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the graph as JSON.")] = False,
) -> None:
    """Show the stages of a frame: what each reads and writes, how long it takes, and what is kept between frames.

    Renders a small built-in scene with given real geometry, and shows the frame after the camera has turned by one
    degree.
    """
    method = require_method(method)
    from deltalight.protocol.files import write_bytes
    from deltalight.services.frame_account import account_frame
    from deltalight.services.graph_drawing import draw_graph

    with _progress() as watch:
        account = account_frame(method, watch)
    if svg is not None:
        write_bytes(svg, draw_graph(account.title, account.sources, account.stages).encode())
        typer.echo(f"The picture is in {svg}.", err=True)
    if as_json:
        typer.echo(json.dumps(account.as_dict(), indent=2))
    else:
        _print_table(account)


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Says on stderr what is being done: a line, and on a terminal one that changes."""
    from rich.console import Console

    typer.echo("Rendering three frames; the first compiles its shaders.", err=True)
    with Console(stderr=True).status("starting") as status:
        yield status.update


def _print_table(account: "FrameAccount") -> None:
    from rich.console import Console
    from rich.table import Table

    from deltalight.services.graph_drawing import format_ms

    console = Console()
    if not console.is_terminal:
        console = Console(width=NARROWEST)
    table = Table("Stage", "Inputs", "Outputs", "Clocks", title=account.title, title_justify="left")
    for heading in ("MB", "Last time"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("This frame")
    for section, stages in account.sections.items():
        table.add_section()
        table.add_row(f"[bold]{section}[/]")
        for stage in stages:
            table.add_row(
                stage.name,
                ", ".join(stage.inputs),
                ", ".join(stage.outputs),
                " ".join(stage.clocks),
                f"{stage.size_bytes / 1e6:.1f}" if stage.size_bytes else "",
                "" if stage.time_ms is None else format_ms(stage.time_ms),
                "ran" if stage.ran else "skipped",
                style=None if stage.ran else "dim",
            )
    console.print(table)
    console.print(account.summary, highlight=False)
