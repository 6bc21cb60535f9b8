"""A variant's pictures of a scene: composites as the render server makes them, with their time."""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from deltalight.benchmarks.quality.case import SceneCase
from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.variants import Variant
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.renderer import SceneRenderer

TIMED_PAIRS = 2
STEP_ASIDE_M = 0.05
"""Far enough for every real surface to be rebuilt: many pixels at any distance in a room."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """Pictures, one per frame.

    `frame_ms`: median time of a frame in which everything is rebuilt. `is_repeatable`: rendering the first frame
    again immediately gave the same bytes. `history_codes`: greatest difference of any channel, in 8-bit codes, when
    it is rendered once more after other frames. `delta_error`: rms of [P1] eq. 9 over the real surfaces in the first
    frame's volume, irradiance in camera units. None if nothing was rendered, or there is no such error.
    """

    pictures: Sequence[Picture]
    frame_ms: float | None = None
    is_repeatable: bool | None = None
    history_codes: int | None = None
    note: str = ""
    delta_error: float | None = None


def render_variant(gpu: GpuContext, case: SceneCase, variant: Variant, volume_size: int | None) -> Rendered:
    """Renders every frame of a scene with a variant of kind `none` or `dvct`.

    Raises:
        DeltalightError: the variant exceeds its memory budget, or requests what is not built.
    """
    documents = [variant.applied(case.truth.document(frame), volume_size) for frame in range(len(case.views))]
    renderer = SceneRenderer(gpu, documents[0])
    try:
        first, again = (renderer.render(case.views[0]).color for _ in range(2))
        delta_error = _delta_error(renderer)
        later, frame_ms = _time_rebuilds(renderer, case.views[0])
        others = _render_rest(renderer, documents, case.views)
    finally:
        renderer.release()
    history_codes = int(np.abs(first.astype(int) - later).max())
    is_repeatable = np.array_equal(first, again)
    return Rendered([first, *others], frame_ms, is_repeatable, history_codes, delta_error=delta_error)


def _delta_error(renderer: SceneRenderer) -> float | None:
    graph = renderer.graph
    if graph is None or "delta error" not in graph:
        return None
    error = read_texture(graph["delta error"]())
    return float(np.sqrt(np.mean(error[error[..., 3] > 0, :3] ** 2)))


def _time_rebuilds(renderer: SceneRenderer, view: ViewFrame) -> tuple[Picture, float]:
    """Returns the last picture and the median time (ms) of frames between which the camera steps aside and back."""
    times_ms: list[float] = []
    aside = _stepped_aside(view)
    for frame in (aside, view) * TIMED_PAIRS:
        started_s = time.perf_counter()
        color = renderer.render(frame).color
        times_ms.append(1000 * (time.perf_counter() - started_s))
    return color, statistics.median(times_ms)


def _stepped_aside(view: ViewFrame) -> ViewFrame:
    assert view.pose is not None  # truth gives every frame its pose
    moved = view.pose.world_from_camera.copy()
    moved[:3, 3] += STEP_ASIDE_M * moved[:3, 0]
    return replace(view, pose=BoardPose(moved))


def _render_rest(
    renderer: SceneRenderer, documents: Sequence[SceneDocument], views: Sequence[ViewFrame]
) -> list[Picture]:
    """Renders the frames after the first, in order, with objects in their poses."""
    pictures = []
    for document, view in zip(documents[1:], views[1:], strict=True):
        renderer.set_scene(document)
        pictures.append(renderer.render(view).color)
    return pictures
