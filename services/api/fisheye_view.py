"""The newest fish-eye picture."""

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.messages import Message, RadianceMessage

PICTURE_PART = 2  # of a radiance message (SPEC.md, section 3)


@dataclass
class FisheyeView:
    """The newest radiance message and its picture for people (JPEG), if any came."""

    newest: tuple[RadianceMessage, bytes] | None = None

    def note(self, message: Message, parts: Sequence[memoryview]) -> None:
        """Keep the picture of a message that has just come."""
        assert isinstance(message, RadianceMessage)
        self.newest = message, bytes(parts[PICTURE_PART])
