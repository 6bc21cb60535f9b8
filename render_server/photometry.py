"""Light and albedo that are found from pictures over time: registration, surroundings, what was seen before."""

from collections.abc import Callable
from dataclasses import replace

from protocol.frames import ViewFrame
from render_server.gpu.context import GpuContext
from render_server.light_registration import (
    Relight,
    find_surroundings,
    ground_radiance,
    observe_albedo,
    register_lights,
    surroundings_shape,
)
from render_server.passes.unseen_albedo import UnseenAlbedo
from render_server.relight.frame import RelightInput
from render_server.scene.albedo_memory import AlbedoMemory
from render_server.scene.lights import LightSet
from render_server.scene.registration import RegistrationAverage

FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 30.0


class GrowingInterval:
    """When to look again: at once, then after waits that double from 1 to 30 s of the frames' own time."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._wait_s = FIRST_WAIT_S

    def is_due(self, timestamp_ns: int) -> bool:
        """Whether it is time; if so, the next wait begins. A clock that was set back begins a wait anew."""
        if self._last_ns is not None and timestamp_ns < self._last_ns:
            self._last_ns = timestamp_ns
        if self._last_ns is None:
            self._last_ns = timestamp_ns
            return True
        if timestamp_ns - self._last_ns < self._wait_s * 1e9:
            return False
        self._last_ns, self._wait_s = timestamp_ns, min(2 * self._wait_s, LONGEST_WAIT_S)
        return True
