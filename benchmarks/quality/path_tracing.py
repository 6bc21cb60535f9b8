"""Path tracing with and without the objects in the time of one relit frame: the papers' equal-time competitor."""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.ground_truth.assembly import Assembly
from benchmarks.ground_truth.render import RoomRenderer
from benchmarks.ground_truth.sensors import srgb_bytes
from benchmarks.quality.case import SceneCase
from benchmarks.quality.figures import linear
from benchmarks.quality.metrics import Picture
from benchmarks.quality.regions import Linear
from benchmarks.quality.renders import Rendered

SEED = 700_001
"""Different from truth's seeds, so that their noise is independent."""
TRIAL_SAMPLES = (1, 9)


@dataclass(frozen=True, eq=False)
class _Pair:
    """One frame's rooms without and with objects; with Mitsuba's geometry built, which is not timed."""

    without: RoomRenderer
    with_objects: RoomRenderer

    def render(self, case: SceneCase, frame: int, spp: int, seed: int) -> tuple[Linear, Linear]:
        """Trace both with different seeds, as a differential renderer without memory does."""
        pose = case.scene.world_from_camera[frame]
        pictures = (
            room.color(pose, spp=spp, seed=seed + index)
            for index, room in enumerate((self.without, self.with_objects))
        )
        without, with_objects = pictures
        return without, with_objects


def trace_in_time(case: SceneCase, frame_ms: float) -> Rendered:
    """Render every frame differentially, with as many samples per pixel as fit in `frame_ms`, at least one.

    Camera picture + (with - without) on real pixels, the traced picture on the objects; both renders have the same
    number of samples. The time to build Mitsuba's scenes is not counted. Mitsuba's variant must be set
    (`ensure_truth` does so).
    """
    with tempfile.TemporaryDirectory(prefix="deltalight-path-") as folder:
        assembly = Assembly(case.scene, Path(folder))
        camera = case.views[0].camera
        without = RoomRenderer(assembly.without(), camera)
        pictures: list[Picture] = []
        times_ms: list[float] = []
        spp = 1
        for frame in range(len(case.views)):
            pair = _Pair(without, RoomRenderer(assembly.with_objects(frame), camera))
            if frame == 0:
                spp = _affordable_samples(pair, case, frame_ms)
            started_s = time.perf_counter()
            traced = pair.render(case, frame, spp, SEED + 2 * frame)
            times_ms.append(1000 * (time.perf_counter() - started_s))
            pictures.append(_composite(case, frame, *traced))
    return Rendered(pictures, float(np.median(times_ms)), note=f"{spp} samples a pixel")


def _affordable_samples(pair: _Pair, case: SceneCase, frame_ms: float) -> int:
    """Return the samples per pixel that fit in a time, from two trials: a fixed and a proportional part."""
    times_ms = []
    for spp in TRIAL_SAMPLES:
        pair.render(case, 0, spp, SEED)  # compiles Mitsuba's kernels for this number
        started_s = time.perf_counter()
        pair.render(case, 0, spp, SEED)
        times_ms.append(1000 * (time.perf_counter() - started_s))
    per_sample_ms = max(times_ms[1] - times_ms[0], 1e-3) / (TRIAL_SAMPLES[1] - TRIAL_SAMPLES[0])
    return max(1, int(TRIAL_SAMPLES[0] + (frame_ms - times_ms[0]) / per_sample_ms))


def _composite(case: SceneCase, frame: int, without: Linear, with_objects: Linear) -> Picture:
    cover = case.frames[frame].cover[..., None]
    relit = linear(case.frames[frame].sensor_without) + with_objects - without
    return srgb_bytes(np.asarray((1 - cover) * relit + cover * with_objects, np.float32))
