"""`deltalight ping`: whether a process answers, for health checks."""

from typing import Annotated

import typer


def ping(
    address: Annotated[
        str,
        typer.Argument(
            help="Control endpoint of a render server (`tcp://...`, `ipc://...`), or address of an API (`http://...`)."
        ),
    ],
    *,
    streams: Annotated[
        bool,
        typer.Option("--streams", help="The endpoint publishes streams: wait for a report from its process."),
    ] = False,
    timeout: Annotated[float, typer.Option(min=0.1, max=60, help="Seconds to wait.")] = 5.0,
) -> None:
    """Check whether a process responds; exit code 0 = yes, 1 = no."""
    from deltalight.services.health_check import check_health

    fault = check_health(address, streams=streams, timeout_s=timeout)
    if fault is not None:
        typer.echo(f"deltalight: {fault}", err=True)
        raise typer.Exit(1)
    typer.echo(f"{address} answers")
