"""One benchmark scene, ready to be rendered and compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene
from deltalight.benchmarks.ground_truth.truth import Truth, TruthFrame
from deltalight.benchmarks.quality.energy import Change
from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.quality.regions import Regions, find_regions
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.source import open_source
from deltalight.sensor_node.view_frames import ViewFrameBuilder


@dataclass(frozen=True, eq=False)
class SceneCase:
    """Truth of a scene with what the renderer sees of it, one view per frame; `changes` by each half of truth."""

    truth: Truth
    frames: Sequence[TruthFrame]
    views: Sequence[ViewFrame]
    regions: Sequence[Regions]
    changes: Sequence[Sequence[Change]]

    @classmethod
    def opened(cls, truth: Truth) -> "SceneCase":
        """Reads all frames of a truth's dataset, cleaned as a node does it.

        Raises:
            DeltalightError: the dataset cannot be read.
        """
        source = open_source(truth.folder)
        builder = ViewFrameBuilder(source)
        frames = [truth.frame(index) for index in range(truth.frame_count)]
        views = [builder(source[index]) for index in range(truth.frame_count)]
        regions = [find_regions(frame.without, frame.with_objects, frame.cover) for frame in frames]
        return cls(truth, frames, views, regions, [_changes(frame) for frame in frames])

    @property
    def scene(self) -> BenchmarkScene:
        """The scene itself."""
        return self.truth.scene

    @cached_property
    def references(self) -> list[Picture]:
        """Sensor pictures with the objects, noise included."""
        return [frame.sensor_with for frame in self.frames]


def _changes(frame: TruthFrame) -> list[Change]:
    pairs = zip(frame.without_halves, frame.with_halves, strict=True)
    return [Change(without, full, find_regions(without, full, frame.cover)) for without, full in pairs]
