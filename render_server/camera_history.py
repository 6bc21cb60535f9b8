"""History of one camera's frames: when something last moved, and which frame the real scene was built from."""

from collections.abc import Callable
from functools import partial

import numpy as np

from deltalight.protocol.frames import DepthImage
from deltalight.render_server.frame import Measurement, Scan
from deltalight.render_server.gpu.kernel import Binding
from deltalight.render_server.scene.depth_surface import DepthSurface, depth_surface, noise_sigma
from deltalight.render_server.scene.motion_detection import FrameSamples, KeptWorld, MotionDetector
from deltalight.render_server.scene.threads import submit
from deltalight.render_server.view import PosedFrame

# A voxel's surface cuts the corner where two surfaces meet at a right angle, by up to sqrt(2) / 4 of its edge.
ROUNDED_VOXELS = 0.35
# Least time between two rebuilds of a kept world that no longer explains the picture.
RENEWAL_NS = 400_000_000
# One that explains it is rebuilt after so long at rest, because a camera that only pauses must not wait for it.
SETTLING_NS = 1_500_000_000
# Of a depth image's pixels, every so many give a first estimate of its median, within these quantiles of them.
SAMPLE_STEP = 61
MEDIAN_QUANTILES = (0.45, 0.55)

FittedOnGpu = Callable[[DepthImage], dict[str, Binding] | None]


class CameraHistory:
    """Decides from one camera's frames when the real scene must be rebuilt, and from which frame.

    With `keeps_world`, that is only when the scene no longer explains what the camera sees (`KeptWorld`), and once
    more from the frame in which everything comes to rest. `has_depth`: the scene is built from depth, not given as a
    model. `on_gpu` returns what the GPU has fitted to a depth image already (`DepthFit`); None if it has not.
    """

    def __init__(self, *, keeps_world: bool, has_depth: bool, on_gpu: FittedOnGpu | None = None) -> None:
        self._motion = MotionDetector()
        self._kept = KeptWorld() if keeps_world else None
        self._has_depth, self._on_gpu = has_depth, on_gpu
        self._expected: FrameSamples | None = None
        self._newest: FrameSamples | None = None
        self._moved_samples: FrameSamples | None = None  # in which anything moved
        self._moved_frame: PosedFrame | None = None
        self.moved = False  # in the newest frame
        self._built_from: PosedFrame | None = None
        self._surfaces: dict[PosedFrame, DepthSurface] = {}
        self._scans: dict[PosedFrame, Scan] = {}
        self._measurements: dict[tuple[int, int], Measurement] = {}
        self.voxel_m: float | None = None  # of the surface that depth is fused to; None: nothing is fused

    def expect(self, taken: PosedFrame) -> None:
        """Begins to sample the next frame in the background, unless the camera moves: then poses suffice."""
        self._expected = None if self.moved else FrameSamples(taken.frame)
        if self._expected is not None:
            self._motion.expect(self._expected)

    def update(self, taken: PosedFrame, *, is_unknown: bool) -> bool:
        """Adds a frame; returns whether anything moved in it. `is_unknown`: there is no real scene yet."""
        expected, self._expected = self._expected, None
        if expected is None or expected.frame is not taken.frame:
            expected = FrameSamples(taken.frame)
        self._newest = samples = expected
        # Depth without a surface (a camera that starts) explains nothing: the next frame counts as another scene.
        self.moved = self._motion.update(samples) or is_unknown
        if self.moved:
            self._moved_samples, self._moved_frame = samples, taken
            self._surfaces.clear()
            self._scans.clear()
        return self.moved

    def is_due(self, *, is_unknown: bool) -> bool:
        """Returns whether the real scene must be rebuilt.

        It must if it is not kept, if it no longer explains the frame, or if everything came to rest.
        """
        if self._kept is None:
            return True
        kept, samples, last, built = self._kept, self._newest, self._moved_samples, self._kept.built_from
        assert samples is not None
        if built is None or is_unknown:
            return True
        if self.moved:
            too_soon = abs(samples.frame.timestamp_ns - built.frame.timestamp_ns) < RENEWAL_NS
            return not (too_soon or self._explains(kept, samples))
        if built is last:
            return self.voxel_m is not None  # whose average takes some more frames
        assert last is not None
        wait_ns = SETTLING_NS if kept.explains(last) else RENEWAL_NS
        return samples.frame.timestamp_ns - last.frame.timestamp_ns >= wait_ns

    def _explains(self, kept: KeptWorld, samples: FrameSamples) -> bool:
        """Returns whether a kept world explains what moves; on a GPU, in the frame before, so that nothing waits."""
        return kept.explains(samples) if self._on_gpu is None else kept.explained_before(samples)

    def renew(self, taken: PosedFrame) -> PosedFrame:
        """Returns the frame to build the real scene from: `taken`, or the last that moved if it was not used yet."""
        if self._kept is not None and self._kept.built_from is not self._moved_samples:
            taken, self.moved = self.moved_frame, True
            self._kept.built_from = self._moved_samples
        return taken

    def set_built(self) -> None:
        """Records that the real scene was built from `moved_frame`."""
        self._built_from = self.moved_frame
        self._scans.clear()
        self._measurements.clear()

    @property
    def moved_frame(self) -> PosedFrame:
        """The frame in which anything last moved, the camera included; there was one."""
        assert self._moved_frame is not None
        return self._moved_frame

    @property
    def is_settled(self) -> bool:
        """Whether a kept world was built from the frame in which everything came to rest."""
        return self._kept is not None and self._kept.built_from is self._moved_samples

    def measurement(self, size: tuple[int, int]) -> Measurement:
        """Returns the frame that the real scene was last built from, at a picture's size, always the same object."""
        if size not in self._measurements:
            assert self._built_from is not None
            taken = self._built_from.at(size)
            self._measurements[size] = Measurement(taken.frame, taken.view, self._scan_of(taken))
        return self._measurements[size]

    def scan(self, size: tuple[int, int]) -> Scan:
        """Returns the camera's measurement from when something last moved, at a picture's size."""
        return self._scan_of(self.moved_frame.at(size))

    def _scan_of(self, taken: PosedFrame) -> Scan:
        if taken not in self._scans:
            self._scans[taken] = self._scanned(taken)
        return self._scans[taken]

    def _scanned(self, taken: PosedFrame) -> Scan:
        """Collects depth, its noise, and the tolerance of the fused surface. A model has no noise.

        Three standard deviations of the noise cover at least what voxels round off.
        """
        depth, fitted = taken.frame.depth if self._has_depth else None, partial(self.surface_of, taken)
        if depth is None:
            return Scan(None, fitted, lambda: None, 0.0, lambda: 1.0, None)
        median, sigma, tolerance = submit(partial(_median_depth, depth)).result, noise_sigma(depth), None
        if self.voxel_m is not None:
            sigma = max(sigma, ROUNDED_VOXELS * self.voxel_m / (3 * median() ** 2))
            # The fused surface agrees with depth up to half a voxel, and three standard deviations of its noise.
            tolerance = 0.5 * self.voxel_m, 3 * sigma
        return Scan(depth, fitted, partial(self._found_on_gpu, depth), sigma, median, tolerance)

    def _found_on_gpu(self, depth: DepthImage) -> dict[str, Binding] | None:
        return None if self._on_gpu is None else self._on_gpu(depth)

    def surface_of(self, taken: PosedFrame) -> DepthSurface:
        """Returns the surface fitted to a frame's depth."""
        if taken not in self._surfaces:
            assert taken.frame.depth is not None
            self._surfaces[taken] = depth_surface(taken.frame.depth, taken.view.camera)
        return self._surfaces[taken]


def _median_depth(depth: DepthImage) -> float:
    """Returns the median of the valid depths, m; 1 if there is none.

    Only depths near that of a sample are put in order: to do so with all of a large picture takes milliseconds.
    """
    metres, valid = depth.depth_m, depth.valid
    count = np.count_nonzero(valid)
    sample = np.sort(metres.ravel()[::SAMPLE_STEP][valid.ravel()[::SAMPLE_STEP]])
    if not len(sample):
        return float(np.median(metres[valid])) if count else 1.0
    low, high = (sample[int(quantile * len(sample))] for quantile in MEDIAN_QUANTILES)
    below = np.count_nonzero((metres < low) & valid)
    near = metres[(metres >= low) & (metres <= high) & valid]
    middle = [(count - 1) // 2 - below, count // 2 - below]
    if middle[0] < 0 or middle[1] >= len(near):
        return float(np.median(metres[valid]))
    return float(np.mean(np.partition(near, middle)[middle]))
