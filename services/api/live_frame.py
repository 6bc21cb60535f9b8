"""A composite for viewers of the live picture: its pictures as JPEG, with their headers."""

from collections.abc import Mapping
from dataclasses import dataclass

from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.live_message import ViewerHeader, age_ms, pack


@dataclass(frozen=True)
class LivePicture:
    """A picture as JPEG, and its `PictureHeader` as JSON."""

    header: bytes
    jpeg: bytes


@dataclass(frozen=True)
class LiveFrame:
    """A composite for viewers; `number` counts the frames that arrived.

    It arrived at `arrived_s` of the monotonic clock and `arrived_ns` of this host's. `pictures` holds the scene's own
    view, first, and those that somebody asked for.
    """

    number: int
    message: CompositeMessage
    arrived_s: float
    arrived_ns: int
    pictures: Mapping[ShownView, LivePicture]

    def shown(self, view: ShownView | None) -> ShownView:
        """Returns what who asked for `view` sees: the scene's own view for None and where it is not there (yet)."""
        return self.message.view if view is None or view not in self.pictures else view

    def picture(self, view: ShownView | None) -> LivePicture:
        """Returns the picture that who asked for `view` sees."""
        return self.pictures[self.shown(view)]

    def packed(self, view: ShownView | None, skipped: int) -> bytes:
        """Returns the message for a viewer of `view` that was not sent `skipped` frames."""
        picture = self.picture(view)
        return pack(picture.header, self.viewer_header(skipped), picture.jpeg)

    def viewer_header(self, skipped: int) -> ViewerHeader:
        """Returns what is said at this moment to a viewer that was not sent `skipped` frames."""
        return ViewerHeader(age_ms=age_ms(self.message), skipped=skipped)
