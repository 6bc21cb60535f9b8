"""Relit pictures of a render server, brought together with the recorded frames that they were made of."""

from collections import deque
from collections.abc import Callable, Sequence

from deltalight.protocol.codecs import decode_color
from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.pictures import encode_png

RELIT_VIEW = "composite"
KEPT_FRAMES = 1024  # half a minute: a renderer that is farther behind has left frames out
KEPT_PICTURES = 8  # that came before their frames, which wait for depth


def relit_picture(message: CompositeMessage, parts: Sequence[memoryview]) -> bytes | None:
    """Returns the relit picture of a message as JPEG or PNG; None if it shows other views only."""
    views = [message.view, *(other.view for other in message.others)]
    if RELIT_VIEW not in views:
        return None
    part = parts[views.index(RELIT_VIEW)]
    if message.encoding == "jpeg":
        return bytes(part)
    return encode_png(decode_color(part, message.encoding, message.shape))


class RelitPictures:
    """Pairs relit pictures with recorded frames by capture time, whichever comes first.

    `write(timestamp_ns, picture)` is called once for each pair.
    """

    def __init__(self, write: Callable[[int, bytes], None]) -> None:
        self.count = 0
        self.last_ns = -1
        self._write = write
        self._waiting: deque[tuple[int, bytes]] = deque(maxlen=KEPT_PICTURES)
        self._frames: deque[int] = deque(maxlen=KEPT_FRAMES)

    @property
    def lacks_last(self) -> bool:
        """Whether the picture of the last frame has not come, though pictures do."""
        return self.count > 0 and self.last_ns < self._frames[-1]

    def add_picture(self, message: CompositeMessage, parts: Sequence[memoryview]) -> None:
        """Takes a message: writes its picture if its frame is recorded, else keep it for a while."""
        picture = relit_picture(message, parts)
        if picture is None or message.capture_ns <= self.last_ns:
            return
        if message.capture_ns in self._frames:
            self._pair(message.capture_ns, picture)
        else:
            self._waiting.append((message.capture_ns, picture))

    def add_frame(self, timestamp_ns: int) -> None:
        """Takes note of a frame that was written."""
        self._frames.append(timestamp_ns)
        picture = dict(self._waiting).get(timestamp_ns)  # of several of one frame, the newest
        if picture is not None:
            self._pair(timestamp_ns, picture)

    def _pair(self, timestamp_ns: int, picture: bytes) -> None:
        self._write(timestamp_ns, picture)
        self.last_ns = timestamp_ns
        self.count += 1
