"""The frame after an error: a stage that was interrupted may have changed what others made, and shows none of it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch, watched
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import EYE, LATER_NS, TARGET, TURNED, Case, scene_of
from tests.render_server.scenes import Stage, checkered, frame, look_at

pytestmark = [pytest.mark.slow(seconds=8), pytest.mark.usefixtures("clean_gl")]

INTERRUPTED = [  # a method, and the run of a kernel after which it fails: within a stage that changes its input
    ("dlpv", "lpv_bounce_share", 1),  # after the first of two bounces
    ("exact", "light_voxels REAL GATHERED", 1),
    ("exact", "resolve_voxels RHO or filter_voxels RESOLVES RHO", 1),  # a GPU's uses up what it reads
    ("exact", "light_voxels VIRTUAL GATHERED", 1),
    ("paper", "split_radiance", 1),
    ("differential", "light_voxels VIRTUAL GATHERED", 1),
    ("aroof", "probe_gather CHANGED", 1),
    ("aroof", "caustic_tiles", 1),
]


def failing_after(kernel: str, runs: int) -> Callable[[Dispatch], None]:
    """A watcher that raises once, after so many runs of a kernel, of which a GPU may have another."""
    counts: Counter[str] = Counter()
    names = tuple(kernel.split(" or "))

    def watch(run: Dispatch) -> None:
        counts[kernel] += run.kernel.startswith(names)
        if counts[kernel] == runs:
            counts[kernel] += 1
            raise MemoryError("interrupted")

    return watch


class Turn:
    """A renderer, and frames of a camera that turns."""

    def __init__(self, gpu: GpuContext, method: str, folder: Path) -> None:
        self.renderer = SceneRenderer(gpu, scene_of(Case(method, "model", "mirror"), Stage(folder)))
        self._render(0, TARGET)

    def _render(self, number: int, target: tuple[float, float, float]) -> np.ndarray:
        seen = frame(checkered(), frame_id=number, timestamp_ns=number * LATER_NS, pose=look_at(EYE, target))
        return self.renderer.render(seen).color

    def turned(self) -> np.ndarray:
        """The picture after a turn."""
        return self._render(1, TURNED)


class Turns:
    """What turns on one device, and the pictures after a turn without an error: of a method once for all kernels."""

    def __init__(self, gpu: GpuContext, make_folder: Callable[[str], Path]) -> None:
        self.gpu, self._make_folder = gpu, make_folder
        self._pictures: dict[str, np.ndarray] = {}

    def begin(self, method: str) -> Turn:
        return Turn(self.gpu, method, self._make_folder(method))

    def undisturbed(self, method: str) -> np.ndarray:
        if method not in self._pictures:
            turn = self.begin(method)
            self._pictures[method] = turn.turned()
            turn.renderer.release()
        return self._pictures[method]


@pytest.fixture(scope="module", params=[True, False], ids=["software", "gpu"])
def turns(request: pytest.FixtureRequest, gpu: GpuContext, tmp_path_factory: pytest.TempPathFactory) -> Turns:
    """Those of the device, as it is, and taken for a GPU."""
    return Turns(replace(gpu, is_software=request.param), tmp_path_factory.mktemp)


@pytest.mark.parametrize(("method", "kernel", "runs"), INTERRUPTED)
def test_the_frame_after_an_error_is_as_if_there_had_been_none(
    method: str, kernel: str, runs: int, turns: Turns
) -> None:
    expected = turns.undisturbed(method)
    disturbed = turns.begin(method)
    with watched(turns.gpu, failing_after(kernel, runs)), pytest.raises(MemoryError):
        disturbed.turned()
    found = disturbed.turned()
    disturbed.renderer.release()
    np.testing.assert_array_equal(found, expected)
