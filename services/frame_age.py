"""How old a picture is."""

import time

from protocol.messages import CompositeMessage


def age_ms(message: CompositeMessage) -> float:
    """How long ago the picture was captured, by this host's clock, ms."""
    return (time.time_ns() - message.capture_ns - message.clock_offset_ns) / 1e6
