"""Arguments of control requests that a render session executes."""

from pathlib import Path

from pydantic import ConfigDict, Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.messages import MAX_OTHERS
from deltalight.protocol.scene_fields import ShownView


class PickRequest(StrictModel):
    """A pixel of the composite (centres are at integers), and an object to look through.

    `camera`: whose picture; None = the first one's.
    """

    model_config = ConfigDict(strict=True)

    x: float
    y: float
    ignore: str | None = None
    camera: str | None = None


class WatchRequest(StrictModel):
    """The views that somebody looks at."""

    views: tuple[ShownView, ...] = Field(max_length=MAX_OTHERS + 1)


class RoomMeshRequest(StrictModel):
    """The GLB file to write the real scene to, on the render server's host."""

    file: Path
