"""Values shared by several commands."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class View(StrEnum):
    """What a picture shows (`output.view` of the scene document)."""

    COMPOSITE = "composite"
    EFFECTS = "effects"
    DELTA = "delta"
    VOLUME = "volume"
    RSM = "rsm"
    LIGHTS = "lights"


class Method(StrEnum):
    """A relighting method: dvct as the scene says, or with one of its operators, or another one with its defaults."""

    DVCT = "dvct"
    EXACT = "exact"
    PAPER = "paper"
    DLPV = "dlpv"
    DLPV_PAPER = "dlpv-paper"
    AROOF = "aroof"
    DIFFERENTIAL = "differential"
    NONE = "none"


ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="Configuration file; default: ./deltalight.toml, then ~/.config/deltalight/deltalight.toml.",
    ),
]
NodeName = Annotated[
    str | None,
    typer.Option("--node", help="Name of a node to find on the network; `auto` takes the only one there is."),
]
