"""Where a scene document's lights come from, frame after frame."""

from typing import Protocol

from protocol import scene_lights as documents
from protocol.frames import ViewFrame
from render_server.lights.lights import LightSet, build_lights
from render_server.lights.median_cut import Split
from render_server.scene.fisheye_lights import FisheyeSource
from render_server.scene.hemisphere_map import HemisphereMap
from render_server.scene.tracked_lamps import TrackedSource


class LightSource(Protocol):
    """Lights that may change from frame to frame."""

    def follow(self, frame: ViewFrame) -> LightSet | None:
        """Return the lights of a frame, not registered yet; None where they are those of the frame before."""
        ...

    @property
    def split(self) -> Split[HemisphereMap] | None:
        """The latest split of a fish-eye picture, for people who look."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user: what is missing, what was found."""
        ...


class GivenLights:
    """Lights of modes `manual` and `environment`: always the same."""

    split: Split[HemisphereMap] | None = None
    remarks: tuple[str, ...] = ()

    def __init__(self, lights: documents.Lights) -> None:
        self._lights: LightSet | None = build_lights(lights)

    def follow(self, frame: ViewFrame) -> LightSet | None:  # noqa: ARG002
        """Return the lights once."""
        lights, self._lights = self._lights, None
        return lights


def open_lights(lights: documents.Lights) -> LightSource:
    """Return the source of a scene document's lights.

    Raises:
        DeltalightError: an environment map that cannot be read.
    """
    match lights.mode:
        case "fisheye":
            return FisheyeSource(lights)
        case "tracked":
            return TrackedSource(lights)
        case _:
            return GivenLights(lights)
