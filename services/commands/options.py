"""Values shared by several commands."""

from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from protocol.errors import DeltalightError


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


def parse_method(name: str) -> Method:
    """The method of that name.

    Raises:
        DeltalightError: there is none.
    """
    known = [method.value for method in Method]
    if name in known:
        return Method(name)
    nearest = get_close_matches(name, known, 1, cutoff=0)[0]
    raise DeltalightError(f"'{name}' is no method; the nearest is {nearest}, of {', '.join(known)}.")


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
