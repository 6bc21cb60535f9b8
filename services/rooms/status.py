"""What is said of rooms: by the keeper to the directory, from there to the web process and the command line."""

from typing import Literal

from pydantic import Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.message_fields import Name

HOST_PATTERN = "^[A-Za-z0-9][A-Za-z0-9._-]{0,252}$"  # of a host's name, which stands in addresses

Reason = Literal["slot", "drained", "failed"]
RoomState = Literal["waiting", "starting", "running", "failed"]


class RoomNode(StrictModel):
    """A sensor node of a room."""

    name: Name
    endpoint: str = Field(description="Of its streams.")


class RoomEndpoints(StrictModel):
    """Endpoints of a room's render server; those with a newer epoch replace them."""

    epoch: int = Field(ge=1, description="Number of render server starts, over all rooms.")
    publish: str = Field(description="Pictures and reports.")
    control: str = Field(description="Commands.")


class RoomStatus(StrictModel):
    """A room: whose frames it shows, how it is doing and where."""

    name: Name
    title: str = ""
    nodes: tuple[RoomNode, ...] = Field(min_length=1)
    state: RoomState = Field(
        description="`waiting` (for a slot, or drained), `starting`, `running`, or `failed` until it is "
        "restarted."
    )
    why: str = Field(default="", description="Why the room is waiting, failed, or shows nothing; else empty.")
    waits_for: Reason | None = Field(
        default=None, description="`slot` = until one is free; `drained`, `failed` = until it is restarted."
    )
    slot: str | None = Field(default=None, description="Slot in which its render server runs.")
    endpoints: RoomEndpoints | None = None
    moving_to: str | None = Field(
        default=None, description="Slot in which its next render server will start."
    )
    restarts: int = Field(default=0, ge=0, description="How often its render server was lost and replaced.")


class SlotStatus(StrictModel):
    """Room for one render server."""

    name: str
    device: str = Field(description="Device on which it renders.")
    room: str | None = Field(description="Room in this slot; null = free.")
    host: str = Field(description="Host of the device.")
    drained: bool = Field(
        default=False, description="Whether its host is drained, so that no room starts there."
    )


class RoomList(StrictModel):
    """All rooms and slots of an installation."""

    rooms: tuple[RoomStatus, ...]
    slots: tuple[SlotStatus, ...]
