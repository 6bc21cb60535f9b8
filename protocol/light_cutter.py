"""From a fish-eye camera's maps of radiance to its lights, frame by frame: cut, residual, tracking."""

from functools import partial

from deltalight.protocol.frames import RadianceMap, ViewFrame
from deltalight.protocol.hemisphere_map import HemisphereMap, WorldSky, to_world
from deltalight.protocol.light_tracker import LightTracker
from deltalight.protocol.median_cut import OcclusionTest, Split, split_map
from deltalight.protocol.occlusion import is_occluded
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import SkyLights

# Texels of 1.6 degrees, finer than glossy surfaces resolve; lights are not in it. Filtering it takes a third of the
# time of a map of mode `environment`, which never changes.
RESIDUAL_SIZE = 128


class LightCutter:
    """Cuts one camera's maps into lights and residual (docs/method.md 2), and tracks both over time.

    A sensor node publishes the result. A render server does the same where nobody sends lights that were cut as its
    scene asks; from the same frames the same lights follow, to the bit.
    """

    def __init__(self, cut: LightCut) -> None:
        self._cut = cut
        self._tracker = LightTracker(cut.smoothing_s)
        self._newest: tuple[RadianceMap, Split[HemisphereMap], WorldSky] | None = None

    def update(self, frame: ViewFrame) -> SkyLights | None:
        """Returns the lights of a frame; None where they did not change, and until a frame brings the first map."""
        newest, seen = self._newest, frame.radiance_map
        if seen is not None and (newest is None or seen is not newest[0]):
            newest = self._newest = self._split(frame, seen)
        elif newest is None or not self._tracker.advance(frame.timestamp_ns):
            return None
        assert self._tracker.residual is not None
        radiance_map, split, sky = newest
        return SkyLights(
            self._cut,
            radiance_map.world_from_fisheye,
            self._tracker.lights,
            tuple(light.region for light in split.lights),
            self._tracker.residual,
            sky.seen,
        )

    def _split(
        self, frame: ViewFrame, seen: RadianceMap
    ) -> tuple[RadianceMap, Split[HemisphereMap], WorldSky]:
        """Cuts a new map and makes it the tracker's target."""
        split = split_map(
            HemisphereMap.of(seen),
            self._cut.count,
            threshold=self._cut.threshold,
            whole_map=self._cut.split == "all",
            is_occluded=_occlusion_test(frame, seen),
        )
        sky = to_world(split.residual, RESIDUAL_SIZE)
        self._tracker.set_target(frame.timestamp_ns, split.lights, sky.filled())
        return seen, split, sky


def _occlusion_test(frame: ViewFrame, seen: RadianceMap) -> OcclusionTest | None:
    if frame.depth is None or frame.pose is None:
        return None
    return partial(is_occluded, frame.depth, frame.pose.world_from_camera, seen.world_from_fisheye[:3, 3])
