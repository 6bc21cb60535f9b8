"""Values shared by several commands."""

import re
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.method_names import METHODS
from deltalight.services.ports import NODE_PORT, endpoint

if TYPE_CHECKING:
    from deltalight.protocol.keys import KeySettings


class View(StrEnum):
    """What a picture shows (`output.view` of the scene document)."""

    COMPOSITE = "composite"
    EFFECTS = "effects"
    DELTA = "delta"
    ERROR = "error"
    VOLUME = "volume"
    RSM = "rsm"
    LIGHTS = "lights"


class Quality(StrEnum):
    """What a moving picture may give up for speed (`method.quality` of the scene document)."""

    LIVE = "live"
    BALANCED = "balanced"
    BEST = "best"


MethodName = Annotated[
    str,
    typer.Option(
        "--method",
        help=f"Relighting method: {', '.join(METHODS)}, or a plugin's; dvct uses the settings of the demo's scene.",
    ),
]


ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="Configuration file; default: ./deltalight.toml, then ~/.config/deltalight/deltalight.toml.",
    ),
]
OneCamera = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="NAME",
        help="Camera whose pictures to use, by the name of its node, if a room has several.",
    ),
]
Device = Annotated[int | None, typer.Option(min=0, help="EGL device; `deltalight doctor` lists them.")]
Data = Annotated[
    Path | None, typer.Option(help="Folder of scenes and assets; default: the user's data folder.")
]
DatabaseAddress = Annotated[
    str | None,
    typer.Option(
        "--database",
        help="PostgreSQL database, such as postgresql://USER@HOST/NAME; default: the SQLite file in the data folder.",
    ),
]
NodeStreams = Annotated[
    list[str] | None,
    typer.Option(
        help="Endpoint of the node's streams; may be given more than once. Default: tcp://127.0.0.1:5601."
    ),
]
NodeName = Annotated[
    str | None,
    typer.Option("--node", help="Name of a node to find on the network; `auto` uses the only one found."),
]
SMALLEST_EDGE = 16
LARGEST_EDGE = 8192


def writable(path: Path | None) -> Path | None:
    """Checks the file that an option names, if any, before the command begins its work.

    Raises:
        DeltalightError: it cannot be written.
    """
    from deltalight.services.files import require_output_file

    if path is not None:
        require_output_file(path)
    return path


def parse_size(text: str) -> tuple[int, int]:
    """Parses `WxH` into width and height in pixels.

    Raises:
        DeltalightError: not two whole numbers within the range of the scene document.
    """
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip().lower())
    edges = [int(edge) for edge in found.groups()] if found else []
    if not edges or min(edges) < SMALLEST_EDGE or max(edges) > LARGEST_EDGE:
        raise DeltalightError(
            f"'{text}' is not a picture size; write WIDTHxHEIGHT such as 640x480, each from {SMALLEST_EDGE} to"
            f" {LARGEST_EDGE}."
        )
    return edges[0], edges[1]


def parse_frames(text: str | None, count: int) -> range:
    """Parses the half-open `A:B` (either may be omitted) into frame numbers of a source of `count` frames.

    Raises:
        DeltalightError: not such a range, or it reaches outside the source or is empty.
    """
    found = re.fullmatch(r"(\d{0,9}):(\d{0,9})", (text or ":").strip())
    if found is None:
        raise DeltalightError(
            f"'{text}' is not a range of frames; write A:B (B is not included), such as 0:10."
        )
    first, end = (
        int(group) if group else default for group, default in zip(found.groups(), (0, count), strict=True)
    )
    if not first < end <= count:
        raise DeltalightError(
            f"The frames {first}:{end} are not in the source, which has {count};"
            f" choose A < B within 0:{count}."
        )
    return range(first, end)


def node_endpoints(subscribe: list[str] | None, node: str | None, settings: "KeySettings") -> list[str]:
    """Returns the given endpoints, or the one of the node to be found, or the default.

    Raises:
        DeltalightError: both were given, or no such node announces itself.
    """
    if node is None:
        return subscribe or [endpoint(NODE_PORT)]
    if subscribe:
        raise DeltalightError("--subscribe and --node both say where the node is; give one of them.")
    from deltalight.services.discovery import node_endpoint

    return [node_endpoint(node, settings)]


def data_folder(data: Path | None, config_file: Path | None = None) -> Path:
    """Returns the web process's data folder: of the command line, the configuration, or the default."""
    from deltalight.services.api.settings import ApiSettings
    from deltalight.services.settings import load_configuration
    from deltalight.services.storage.store import default_folder

    return data or load_configuration(config_file).section("api", ApiSettings).data or default_folder()
