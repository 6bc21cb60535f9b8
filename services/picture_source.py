"""The newest relit picture of a render server, for commands that show it elsewhere."""

import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.envelope import decode
from deltalight.protocol.keys import KeySettings
from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.pictures import decode_rgb
from deltalight.protocol.receiver import Receiver
from deltalight.services.relit_pictures import relit_picture


class PictureSource:
    """Receives the pictures of the render server that it was told to `follow` last, none before that.

    `camera` = the only one of several whose pictures count.
    """

    def __init__(self, camera: str | None, keys: KeySettings) -> None:
        self._topics = ["composite" if camera is None else f"composite.{camera}"]
        self._keys = keys
        self._receiver = Receiver((), self._topics)

    def follow(self, endpoint: str | None) -> None:
        """Receives from this endpoint from now on, None = from nowhere; one other thread may call it.

        Raises:
            DeltalightError: the endpoint leaves the host without keys, or is malformed.
        """
        places = () if endpoint is None else (endpoint,)
        receiver = Receiver(places, self._topics, keys=self._keys.load(places))
        before, self._receiver = self._receiver, receiver
        before.close()  # which wakes who waits for its pictures

    def newest(self, timeout_s: float) -> UInt8[np.ndarray, "h w 3"] | None:
        """Returns the newest relit picture (sRGB) that comes within this time, None if there is none.

        Raises:
            DeltalightError: a message cannot be read.
        """
        for multipart in (self._receiver.latest(timeout_s) or {}).values():
            message, parts = decode(multipart)
            if isinstance(message, CompositeMessage) and (coded := relit_picture(message, parts)) is not None:
                return decode_rgb(coded, "of the render server")
        return None

    def close(self) -> None:
        """Stops receiving."""
        self._receiver.close()
