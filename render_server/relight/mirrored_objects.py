"""Objects in smooth real surfaces by rays (passes/mirror_objects.py)."""

from collections.abc import Callable
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.passes.mirror_objects import MirrorObjectsPass
from render_server.passes.object_tree import ObjectTree
from render_server.passes.sampling_grid import SamplingGrid
from render_server.relight.frame import RelightInput


class MirroredObjects:
    """Holds the pass while the scene declares surfaces for it; `gather` and `defines` are the pass'."""

    def __init__(
        self,
        gpu: GpuContext,
        grid: SamplingGrid,
        objects: ObjectTree,
        gather: str,
        defines: dict[str, int],
    ) -> None:
        self._making = gpu, grid, objects, gather, defines
        self._pass: MirrorObjectsPass | None = None

    def run(
        self, frame: RelightInput, bind_light: Callable[[], None], uniforms: dict[str, Any], *, wanted: bool
    ) -> moderngl.Texture | None:
        """What such surfaces reflect of the objects; None (also if not `wanted`) leaves it to the cones."""
        if not wanted or not frame.surface_uniforms["specular_surfaces"]:
            self.release()
            return None
        if self._pass is None:
            self._pass = MirrorObjectsPass(*self._making)
        with frame.timers.measure("mirror"):
            self._pass.run(frame.matte, bind_light, uniforms)
        return self._pass.reflection

    def release(self) -> None:
        """Free the GL objects."""
        if self._pass is not None:
            self._pass.release()
        self._pass = None
