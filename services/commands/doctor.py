"""`deltalight doctor`: examine this machine."""

import json
from typing import Annotated

import typer


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Check what this machine has and what is missing; exit code 1 if something required is missing."""
    from deltalight.services.doctor import examine

    checks = list(examine())
    if as_json:
        typer.echo(json.dumps([check.as_dict() for check in checks], indent=2))
    else:
        _print_table([check.as_dict() for check in checks])
    raise typer.Exit(1 if any(check.state == "missing" for check in checks) else 0)


def _print_table(checks: list[dict[str, str]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    marks = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "missing": "[red]missing[/]"}
    table = Table(box=None)
    for heading in ("", "What", "Found"):
        table.add_column(heading, overflow="fold")
    for check in checks:
        table.add_row(marks[check["state"]], escape(check["name"]), escape(check["detail"]))
    console = Console()
    console.print(table)
    for check in checks:
        if check["hint"]:  # in one piece, because it may hold a command to be copied
            console.print(
                f"\n{check['name']}: {check['hint']}", markup=False, highlight=False, soft_wrap=True
            )
