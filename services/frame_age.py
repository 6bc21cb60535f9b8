"""Age of a picture."""

import time

from protocol.messages import CompositeMessage


def age_ms(message: CompositeMessage) -> float:
    """Return the time since the picture's capture, by this host's clock, ms."""
    return (time.time_ns() - message.capture_ns - message.clock_offset_ns) / 1e6
