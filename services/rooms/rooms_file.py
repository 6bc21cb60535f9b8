"""The rooms file of `deltalight up --rooms`: the nodes, the rooms that show them, and the slots that rooms run in."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from deltalight.protocol.documents import StrictModel, nearest, read_mapping, validate
from deltalight.protocol.endpoints import parse_endpoint
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import Name
from deltalight.sensor_node.cameras.drivers import SYNTHETIC
from deltalight.sensor_node.cameras.open import is_live

MAX_ROOMS = 64
MAX_NODES = 16  # that one render server reads
MAX_DEVICE = 255
MAX_ADDRESS = 1024  # characters of a source or an endpoint
MAX_LABELS = 32  # of a room

Device = Annotated[int, Field(ge=0, le=MAX_DEVICE)] | None
# As Ray, or Kubernetes, has them.
LabelKey = Annotated[str, Field(min_length=1, max_length=317)]
LabelValue = Annotated[str, Field(max_length=63)]


class NodeEntry(StrictModel):
    """A sensor node: of this host with its `source`, `found` on the network by its name, or at an `endpoint`."""

    source: str | None = Field(
        default=None,
        min_length=1,
        max_length=MAX_ADDRESS,
        description="Camera, dataset folder, .mcap recording or `synthetic`; paths are relative to the rooms "
        "file.",
    )
    found: Name | None = Field(
        default=None, description="Name under which a node on another host announces itself."
    )
    endpoint: str | None = Field(
        default=None,
        max_length=MAX_ADDRESS,
        description="Endpoint at which a node on another host publishes, `tcp://KEY@HOST:PORT`.",
    )

    @model_validator(mode="after")
    def _is_one_of_all(self) -> Self:
        if sum(each is not None for each in (self.source, self.found, self.endpoint)) != 1:
            raise ValueError(
                "give either the source of a node here, or the name of one that is found, or an endpoint"
            )
        if self.endpoint is not None:
            parse_endpoint(self.endpoint)
        return self


class RoomEntry(StrictModel):
    """A room: whose frames it shows, and the scene that it begins with."""

    nodes: tuple[Name, ...] = Field(
        min_length=1,
        max_length=MAX_NODES,
        description="Nodes of this file whose frames the room shows; rooms may share nodes.",
    )
    scene: Path | None = Field(
        default=None,
        description="Scene document to import and show; null = the last one shown, else the recording's.",
    )
    title: str = Field(default="", max_length=200, description="Title to display; empty = the name.")
    labels: dict[LabelKey, LabelValue] = Field(
        default={},
        max_length=MAX_LABELS,
        description="Labels that its host in a cluster must have, such as the camera's network.",
    )


class RoomsFile(StrictModel):
    """Nodes and rooms by name, and `slots`: how many rooms run at once, or the EGL device of each slot."""

    slots: (
        Annotated[int, Field(ge=1, le=MAX_ROOMS)]
        | Annotated[tuple[Device, ...], Field(min_length=1, max_length=MAX_ROOMS)]
        | Literal["auto"]
    ) = Field(
        default=1,
        description="Number of rooms that run at once on this host, or a list with the EGL device of each slot, "
        "or `auto` = as many as fit according to `figures`.",
    )
    figures: Path | None = Field(
        default=None,
        description="report.json of `deltalight gpu-check --steps memory,speed` on a device like those of the slots.",
    )
    frames_per_s: Annotated[float, Field(gt=0, le=240)] = Field(
        default=30.0, description="Frame rate that each room should reach, for `slots: auto`."
    )
    nodes: dict[Name, NodeEntry] = Field(min_length=1, max_length=MAX_ROOMS)
    rooms: dict[Name, RoomEntry] = Field(min_length=1, max_length=MAX_ROOMS)

    @model_validator(mode="after")
    def _auto_has_figures(self) -> Self:
        if self.slots == "auto" and self.figures is None:
            raise ValueError("`slots: auto` needs `figures`, the report.json of `deltalight gpu-check`")
        return self

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        for name, room in self.rooms.items():
            if name in self.nodes:
                raise ValueError(f"{name} is both a node and a room; give the room another name")
            if len(set(room.nodes)) < len(room.nodes):
                raise ValueError(f"the room {name} names a node twice; name each once")
            for node in room.nodes:
                if node not in self.nodes:
                    known = nearest(node, self.nodes) or ", ".join(self.nodes)
                    raise ValueError(f"the room {name} shows the unknown node {node}; write {known} instead")
        return self

    @property
    def devices(self) -> tuple[int | None, ...]:
        """The EGL device of each slot; None = the driver's first. `auto` has none: see `capacity.with_slots`."""
        assert self.slots != "auto"
        return (None,) * self.slots if isinstance(self.slots, int) else self.slots


def load_rooms(path: Path) -> RoomsFile:
    """Reads a rooms file (YAML or JSON); paths in it become absolute.

    Raises:
        DeltalightError: it is missing, malformed, or names what it does not define.
    """
    rooms = validate(RoomsFile, read_mapping(path), str(path))
    folder = path.absolute().parent
    nodes = {name: _placed(node, folder) for name, node in rooms.nodes.items()}
    entries = {name: _with_scene(name, room, folder) for name, room in rooms.rooms.items()}
    figures = None if rooms.figures is None else folder / rooms.figures
    return rooms.replaced(nodes=nodes, rooms=entries, figures=figures)


def require_cluster_form(rooms: RoomsFile) -> None:
    """Checks a file whose rooms run on a cluster.

    Raises:
        DeltalightError: it names devices, which hosts of a cluster choose themselves.
    """
    if isinstance(rooms.slots, tuple):
        raise DeltalightError(
            "hosts of a cluster choose the EGL devices of their slots themselves; give `slots` as a number."
        )


def require_local_form(rooms: RoomsFile) -> None:
    """Checks a file whose rooms run on this host.

    Raises:
        DeltalightError: a room asks for labels, which only hosts of a cluster have.
    """
    labelled = next((name for name, room in rooms.rooms.items() if room.labels), None)
    if labelled is not None:
        raise DeltalightError(
            f"the room {labelled} asks for labels, which hosts of a cluster have: add --placer ray."
        )


def _placed(node: NodeEntry, folder: Path) -> NodeEntry:
    source = node.source
    if source is None or source == SYNTHETIC or is_live(source):
        return node
    return node.replaced(source=str(folder / source))


def _with_scene(name: str, room: RoomEntry, folder: Path) -> RoomEntry:
    if room.scene is None:
        return room
    scene = folder / room.scene
    if not scene.is_file():
        raise DeltalightError(
            f"the scene {scene} of the room {name} does not exist; name a scene document that does."
        )
    return room.replaced(scene=scene)
