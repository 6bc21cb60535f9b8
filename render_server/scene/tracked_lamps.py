"""Lights of mode `tracked`: lamps with a marker on them (METHOD 2, mode 1)."""

import numpy as np
from jaxtyping import Float64

from protocol import scene_lights as documents
from protocol.frames import ViewFrame
from render_server.lights.lights import AMBIENT_SIZE, LightSet, SphereLight, complete_set
from render_server.lights.median_cut import Split
from render_server.lights.octahedral import above_horizon
from render_server.scene.hemisphere_map import HemisphereMap

# Of a lamp's radius: it stays where it is until it has moved so far. Its shadows' soft edges then lie off by a
# twentieth of their width, while the noise of the marker's pose would make them tremble and cost a rebuild a frame.
STILL_SHARE = 0.1


class TrackedSource:
    """Turns the poses of lamps into light sets; a lamp out of sight stays where it was seen last."""

    def __init__(self, lights: documents.Lights) -> None:
        self._wished = lights
        self._places: dict[int, Float64[np.ndarray, " 3"]] = {}
        self._in_sight: set[int] = set()
        self._begun = False
        self.split: Split[HemisphereMap] | None = None  # no picture is split

    def follow(self, frame: ViewFrame) -> LightSet | None:
        """Return the lights of a frame, not registered yet; None where they are those of the frame before."""
        poses = {lamp.marker: lamp.world_from_marker for lamp in frame.lamps}
        self._in_sight = set(poses)
        changed = not self._begun
        self._begun = True
        for lamp in self._wished.tracked:
            if lamp.marker in poses:
                place = (poses[lamp.marker] @ (*lamp.offset_m, 1.0))[:3]
                changed |= self._move(lamp, place)
        return self._lights() if changed else None

    def _move(self, lamp: documents.TrackedLamp, place: Float64[np.ndarray, "3"]) -> bool:
        last = self._places.get(lamp.marker)
        if last is not None and np.linalg.norm(place - last) <= STILL_SHARE * lamp.radius_m:
            return False
        self._places[lamp.marker] = place
        return True

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user on lamps that are not in sight."""
        unseen = [lamp.marker for lamp in self._wished.tracked if lamp.marker not in self._places]
        lost = [marker for marker in self._places if marker not in self._in_sight]
        sentences = []
        if unseen:
            sentences.append(
                f"No picture has shown the marker of {_lamps(unseen)} yet, so no light comes from there: turn it to "
                "the camera, and see that board.yaml has it in lamp_markers."
            )
        if lost:
            sentences.append(
                f"The marker of {_lamps(lost)} is out of sight in some frames; there the light stays where it was."
            )
        return tuple(sentences)

    def _lights(self) -> LightSet:
        shown = [lamp for lamp in self._wished.tracked if lamp.marker in self._places]
        return complete_set(
            self._wished,
            tuple(_light(lamp, self._places[lamp.marker]) for lamp in shown),
            np.zeros((AMBIENT_SIZE, AMBIENT_SIZE, 3), np.float32),
            1 - above_horizon(AMBIENT_SIZE),
            tuple(lamp.marker for lamp in shown),
        )


def _light(lamp: documents.TrackedLamp, place: Float64[np.ndarray, "3"]) -> SphereLight:
    color = np.array(lamp.color_linear, np.float32)
    return SphereLight(place.astype(np.float32), lamp.intensity * color, lamp.radius_m)


def _lamps(markers: list[int]) -> str:
    return f"lamp {markers[0]}" if len(markers) == 1 else f"lamps {', '.join(map(str, markers))}"
