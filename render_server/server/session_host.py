"""What a render session says of itself, and what it asks of the process around it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument


@dataclass(frozen=True)
class SourceInUse:
    """The endpoints being read, and whether they changed."""

    endpoints: Sequence[str]
    is_another: bool


@dataclass(frozen=True)
class SessionIdentity:
    """Who a render session says that it is.

    Attributes:
        name: the render server's name.
        epoch: orders the render servers of a room.
        renderer_name: the device's, for statistics.
    """

    name: str = "render-server"
    epoch: int | None = None
    renderer_name: str = ""


def _only_configured(_endpoints: Sequence[str] | None) -> SourceInUse:
    raise DeltalightError("This render session cannot change its source; start it with other endpoints.")


@dataclass(frozen=True)
class SessionHost:
    """What the process around a render session does for it; by default nothing.

    Attributes:
        keep_scene: is called with every accepted scene, so that a restart can resume with it.
        mailbox_drops: returns the number of messages that the receiver dropped, by topic.
        use_source: reads other endpoints (None: those configured).
        count_objects: returns the number of objects on the GPU, by kind.
    """

    keep_scene: Callable[[SceneDocument], None] = lambda _scene: None
    mailbox_drops: Callable[[], Mapping[str, int]] = dict
    use_source: Callable[[Sequence[str] | None], SourceInUse] = _only_configured
    count_objects: Callable[[], Mapping[str, int]] = dict
