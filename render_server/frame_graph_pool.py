"""The frame graphs of a room's cameras, kept as long as picture sizes and method stay."""

from collections.abc import Iterator, Sequence

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.frame_graph import FrameGraph, frame_graphs
from deltalight.render_server.freed_memory import give_back_garbage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.methods.registry import MethodChoice
from deltalight.render_server.precomputation.precomputed import Precomputed
from deltalight.render_server.view import CameraView


class FrameGraphPool:
    """Holds a frame graph for each camera in a room: for the `newest` frame, and for its refined picture at rest.

    In software it also keeps those of the picture size before, which a frame budget may choose again; a GPU rebuilds
    them in no time, and its memory is scarcer. `checks` is `Graph`'s.
    """

    def __init__(
        self, gpu: GpuContext, precomputed: Precomputed, timers: PassTimers, *, checks: bool = False
    ) -> None:
        self._gpu, self._precomputed, self._timers, self._checks = gpu, precomputed, timers, checks
        self.newest: list[FrameGraph] = []
        self._best: list[FrameGraph] = []
        self._spare: list[FrameGraph] = []
        self._refused: tuple[tuple[MethodChoice, list[tuple[int, int]]], str] | None = None

    def fit(self, views: Sequence[CameraView], method: MethodChoice) -> list[FrameGraph]:
        """Returns the newest frame's graphs, rebuilt if lens, picture size or the number of cameras changed.

        Raises:
            DeltalightError: something is larger than this GPU allows; it is not tried again for every frame.
        """
        if len(views) != len(self.newest):
            self._free(self._spare)
        elif self._gpu.is_software and not _fit(self.newest, views):
            self.newest, self._spare = self._spare, self.newest
        before, self.newest = self.newest, []
        self.newest = self._fitting(before, views, method)
        return self.newest

    def fit_best(self, views: Sequence[CameraView], method: MethodChoice) -> list[FrameGraph]:
        """Returns the graphs of refined pictures; otherwise as `fit`."""
        before, self._best = self._best, []
        self._best = self._fitting(before, views, method)
        return self._best

    def of_first_camera(self) -> Iterator[FrameGraph]:
        """Yields all graphs of the first camera, which own what the room's cameras share."""
        for graphs in (self.newest, self._best, self._spare):
            yield from graphs[:1]

    def _fitting(
        self, graphs: list[FrameGraph], views: Sequence[CameraView], method: MethodChoice
    ) -> list[FrameGraph]:
        """Returns these graphs if they fit, else new ones in their place."""
        if _fit(graphs, views):
            return graphs
        self._free(graphs)
        wanted = method, [view.size for view in views]
        if self._refused is not None and self._refused[0] == wanted:
            raise DeltalightError(self._refused[1])
        try:
            return frame_graphs(
                self._gpu, views, method, self._precomputed, self._timers, checks=self._checks
            )
        except DeltalightError as refusal:
            self._refused = wanted, str(refusal)
            raise

    def clear(self) -> None:
        """Frees all graphs, because they belong to another method or room."""
        self._free(self.newest, self._best, self._spare)

    def _free(self, *rooms: list[FrameGraph]) -> None:
        """Frees the graphs of these lists, and empties them."""
        is_any = any(rooms)
        release_all(*(each for graphs in rooms for each in graphs[:1]))
        for graphs in rooms:
            graphs.clear()
        if self._gpu.is_software and is_any:
            give_back_garbage()

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self.of_first_camera())


def _fit(graphs: Sequence[FrameGraph], views: Sequence[CameraView]) -> bool:
    """Returns whether there is a graph for each view's pictures."""
    return len(graphs) == len(views) and all(
        graph.fits(view) for graph, view in zip(graphs, views, strict=True)
    )
