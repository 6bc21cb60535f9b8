"""A frame that its graph can compose, at the size and quality that were chosen for it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene_fields import View
from deltalight.render_server.frame_budget import Level
from deltalight.render_server.frame_graph import CompositeOptions, FrameGraph, ShownBuffers
from deltalight.render_server.passes.composite import Composite, Crossfade, Enlarge, Picture


@dataclass(frozen=True, eq=False)
class Fade:
    """A crossfade from the frame `before` to its refined picture, which shows with the weight `fraction` (0..1)."""

    before: "RelitFrame"
    fraction: float
    crossfade: Crossfade


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """A frame that `graph` can compose.

    Attributes:
        frame: the camera's frame, at the composite's size.
        graph: holds the frame's inputs, at the size of `level`.
        options: how it is composed.
        level: quality and scale that the frame is rendered at.
        moves: whether anything in it moves, the camera included.
        enlarge: enlarges its picture to the frame's size; None if it has that size.
        fade: its refined picture is being faded in; None if it is shown whole.
    """

    frame: ViewFrame
    graph: FrameGraph
    options: CompositeOptions
    level: Level
    moves: bool
    enlarge: Enlarge | None
    fade: Fade | None = None

    def compose(self, *, with_linear: bool) -> Picture:
        """Renders the picture (its `code`), and its linear radiance if `with_linear`, unless it is enlarged."""
        options = self.options
        composite = self.graph.render(
            CompositeOptions(options.output, options.additive, options.relights_real, with_linear)
        )
        if self.enlarge is not None:
            coverage = self.shown().object_coverage
            self.enlarge.run(self.frame.color, self.graph.buffers.image, composite, coverage)
            return self.enlarge
        if self.fade is None or with_linear:
            return composite
        before = self.fade.before.compose(with_linear=False)
        self.fade.crossfade.run(before.code, composite.code, self.fade.fraction)
        return self.fade.crossfade

    def compose_view(self, view: View) -> Composite:
        """Renders the frame in another view, at the size of its graph."""
        output = self.options.output.replaced(view=view)
        with_linear = view == "composite" and output.has_bloom
        return self.graph.render_view(replace(self.options, output=output, with_linear=with_linear))

    def shown(self) -> ShownBuffers:
        """Returns the geometry buffers."""
        return self.graph.shown()

    def radiance(self) -> Float64[np.ndarray, "h w 3"]:
        """Returns the radiance of the virtual objects, camera units."""
        return self.graph.radiance()
