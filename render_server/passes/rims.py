"""Rims of real things before the objects: how much of a pixel they fill, and their own colour."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images, bind_samplers, release_target
from render_server.passes.matte import MattePass
from render_server.passes.picture import Picture

RIM_SIGHT = 6
"""Pixels within which a rim's pixel finds the real thing and the background alone: behind the two that may be mixed
there are four more on either side."""


class RimsPass:
    """Corrects a matte where its edge is that of a real thing, and fills the picture's `rims`."""

    def __init__(self, gpu: GpuContext, picture: Picture) -> None:
        self._picture = picture
        self._threads = list_threads(gpu)
        self._target = gpu.ctx.framebuffer(color_attachments=[picture.rims])
        self._program = ComputeProgram(
            gpu, Path(__file__).with_name("rims.comp.glsl"), {"RIM_SIGHT": RIM_SIGHT}
        )

    def run(
        self, matte: MattePass, uniforms: dict[str, Any], coverage: moderngl.Texture | None = None
    ) -> None:
        """Look at the pixels that `matte` listed; arguments and bound textures as it had them."""
        self._target.clear()
        picture = self._picture
        bind_samplers({1: picture.linear, 15: picture.rays} | ({} if coverage is None else {2: coverage}))
        matte.edges.bind_to_storage_buffer(6)
        bind_images(matte.texture, picture.rims)
        self._program.run((self._threads,), antialiased=coverage is not None, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        release_target(self._target)
        self._program.release()
