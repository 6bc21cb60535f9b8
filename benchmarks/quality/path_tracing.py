"""Path tracing with and without the objects in the time of one relit frame: the papers' equal-time competitor.

With a denoiser it is what a practitioner would do today.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deltalight.benchmarks.ground_truth.assembly import Assembly
from deltalight.benchmarks.ground_truth.parts import Matrix
from deltalight.benchmarks.ground_truth.render import SUBPIXELS, RoomRenderer, softened
from deltalight.benchmarks.ground_truth.sensors import srgb_bytes
from deltalight.benchmarks.quality.case import SceneCase
from deltalight.benchmarks.quality.denoising import Denoiser
from deltalight.benchmarks.quality.figures import linear
from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.quality.regions import Linear
from deltalight.benchmarks.quality.renders import Rendered

SEED = 700_001
"""Different from truth's seeds, so that their noise is independent."""
FURTHER_TRIAL_SAMPLES = 8


@dataclass(frozen=True, eq=False)
class _Pair:
    """One frame's rooms without and with objects; with Mitsuba's geometry built, which is not timed."""

    without: RoomRenderer
    with_objects: RoomRenderer
    denoiser: Denoiser | None

    @property
    def least_samples(self) -> int:
        """Samples per pixel come in multiples of this: `RoomRenderer.color` has subpixels, `guided` has none."""
        return SUBPIXELS**2 if self.denoiser is None else 1

    def render(self, pose: Matrix, spp: int, seed: int) -> tuple[Linear, Linear]:
        """Traces both with different seeds, as a differential renderer without memory does, and denoises each."""
        without = self._render(self.without, pose, spp, seed)
        return without, self._render(self.with_objects, pose, spp, seed + 1)

    def _render(self, room: RoomRenderer, pose: Matrix, spp: int, seed: int) -> Linear:
        if self.denoiser is None:
            return room.color(pose, spp=spp, seed=seed)
        return softened(self.denoiser(room.guided(pose, spp=spp, seed=seed)))


def trace_in_time(case: SceneCase, frame_ms: float, *, is_denoised: bool = False) -> Rendered:
    """Renders every frame differentially, with as many samples per pixel as fit in `frame_ms`, at least the fewest.

    Camera picture + (with - without) on real pixels, the traced picture on the objects; both renders have the same
    number of samples, and both are denoised before they are subtracted, which takes a part of the time. The time to
    build Mitsuba's scenes is not counted. Mitsuba's variant must be set (`ensure_truth` does so).

    Raises:
        DeltalightError: there is no denoiser.
    """
    camera = case.views[0].camera
    denoiser = Denoiser((camera.width, camera.height)) if is_denoised else None
    try:
        return _trace(case, frame_ms, denoiser)
    finally:
        if denoiser is not None:
            denoiser.release()


def _trace(case: SceneCase, frame_ms: float, denoiser: Denoiser | None) -> Rendered:
    with tempfile.TemporaryDirectory(prefix="deltalight-path-") as folder:
        assembly = Assembly(case.scene, Path(folder))
        camera, max_depth = case.views[0].camera, case.scene.max_depth
        without = RoomRenderer(assembly.without(), camera, max_depth=max_depth)
        pictures: list[Picture] = []
        times_ms: list[float] = []
        spp = 1
        for frame, pose in enumerate(case.scene.world_from_camera):
            room = RoomRenderer(assembly.with_objects(frame), camera, max_depth=max_depth)
            pair = _Pair(without, room, denoiser)
            if frame == 0:
                spp = _affordable_samples(pair, pose, frame_ms)
            started_s = time.perf_counter()
            traced = pair.render(pose, spp, SEED + 2 * frame)
            times_ms.append(1000 * (time.perf_counter() - started_s))
            pictures.append(_composite(case, frame, *traced))
    return Rendered(pictures, float(np.median(times_ms)), note=f"samples a pixel: {spp}")


def _affordable_samples(pair: _Pair, pose: Matrix, frame_ms: float) -> int:
    """Returns the samples per pixel that fit in a time, from two trials: a fixed and a proportional part."""
    step, times_ms = pair.least_samples, []
    for spp in (step, step + FURTHER_TRIAL_SAMPLES):
        pair.render(pose, spp, SEED)  # compiles Mitsuba's kernels for this number
        started_s = time.perf_counter()
        pair.render(pose, spp, SEED)
        times_ms.append(1000 * (time.perf_counter() - started_s))
    per_sample_ms = max(times_ms[1] - times_ms[0], 1e-3) / FURTHER_TRIAL_SAMPLES
    further = max(0, int((frame_ms - times_ms[0]) / per_sample_ms))
    return step + further // step * step


def _composite(case: SceneCase, frame: int, without: Linear, with_objects: Linear) -> Picture:
    cover = case.frames[frame].cover[..., None]
    relit = linear(case.frames[frame].sensor_without) + with_objects - without
    return srgb_bytes(np.asarray((1 - cover) * relit + cover * with_objects, np.float32))
