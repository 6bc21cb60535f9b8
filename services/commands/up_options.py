"""Options of `deltalight up`."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class PlacerKind(StrEnum):
    """What runs the render servers of rooms."""

    LOCAL = "local"
    RAY = "ray"


SourceOfNode = Annotated[
    str | None,
    typer.Option(
        help="Camera, dataset folder, .mcap recording or `synthetic`; default: from the configuration."
    ),
]
ShownScene = Annotated[
    Path | None,
    typer.Option(
        help="Scene document to import and show; default: the last one shown, else the recording's."
    ),
]
PagePort = Annotated[int, typer.Option(min=1, max=65535, help="Port of the dashboard.")]
NodePort = Annotated[int, typer.Option(min=1, max=65535, help="Port of the node's streams.")]
CompositePort = Annotated[int, typer.Option(min=1, max=65535, help="Port of the relit pictures.")]
ControlPort = Annotated[int, typer.Option(min=1, max=65535, help="Port of the commands.")]
AllowSoftware = Annotated[
    bool, typer.Option("--allow-software", help="Render without a GPU if there is none.")
]
Spares = Annotated[
    bool,
    typer.Option(
        "--spares/--no-spares",
        help="Keep a spare of each process, which replaces a dead one sooner (some 350 MB, and "
        "as much as the render server takes, whose scene is built ahead).",
    ),
]
RoomsFile = Annotated[
    Path | None,
    typer.Option(help="Rooms file: several rooms at once, each with nodes and a scene of its own."),
]
RoomsPort = Annotated[
    int, typer.Option(min=1, max=65535, help="Port of the directory of rooms, with --rooms.")
]
RoomsHostAddress = Annotated[
    str, typer.Option(help="Address of this host at which the directory answers, with --placer ray.")
]
Placer = Annotated[
    PlacerKind, typer.Option(help="What runs the rooms: this host, or the hosts of a Ray cluster.")
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        help="Cluster to join, HOST:PORT or `auto`, with --placer ray; default: one of this host alone."
    ),
]
