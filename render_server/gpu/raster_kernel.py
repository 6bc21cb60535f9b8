"""Kernels that draw triangles: a vertex and a fragment shader."""

from collections.abc import Mapping
from functools import partial
from typing import Protocol

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Program, Shader, label_of
from deltalight.render_server.gpu.shader_source import SHADERS, declarations, shader_source

CLIP_DISTANCE0 = 0x3000  # GL_CLIP_DISTANCE0, which moderngl does not name


class Drawable(Protocol):
    """Geometry that a raster kernel draws."""

    @property
    def triangle_count(self) -> int:
        """How many triangles are drawn."""

    def draw(self, program: moderngl.Program) -> None:
        """Draws all triangles with `program`."""


class RasterKernel(Shader):
    """A vertex and a fragment shader of one name; draws with depth test into a framebuffer."""

    def __init__(self, gpu: GpuContext, name: str, **defines: float | str) -> None:
        super().__init__(gpu, name, defines)

    def _stages(self, defines: Mapping[str, float | str]) -> tuple[str, str]:
        vertex, fragment = (SHADERS / f"{self._name}.{stage}.glsl" for stage in ("vert", "frag"))
        return shader_source(vertex, defines), shader_source(fragment, defines)

    def _text(self, defines: Mapping[str, float | str]) -> str:
        return "\n".join(self._stages(defines))

    def _compiled(self, defines: Mapping[str, float | str]) -> Program:
        (vertex, fragment), label = self._stages(defines), label_of(self._name, defines)
        self._gpu.compiled(label, {"vert": vertex, "frag": fragment})

        def link() -> Program:
            program = self._gpu.ctx.program(vertex_shader=vertex, fragment_shader=fragment)
            return Program(self._gpu, label, program, declarations(self._text(defines)))

        return self._shared(vertex, fragment, link=link)

    def draw(
        self,
        target: moderngl.Framebuffer,
        mesh: Drawable,
        *shared: Bindings,
        box: tuple[int, int, int, int] | None = None,
        clips: bool = False,
        **own: Binding,
    ) -> None:
        """Draws `mesh` into `target`, or into its `box` (x, y, width, height); `clips` heeds gl_ClipDistance[0].

        Raises:
            BindingError: as `Kernel.run`.
        """
        linked, _ = self._bound(own, shared)
        target.use()
        target.viewport = box or (0, 0, *target.size)
        target.scissor = box  # type: ignore[assignment]  # None lifts it, which the stubs do not know
        self._gpu.ctx.enable_only(moderngl.DEPTH_TEST)
        if clips:
            self._gpu.ctx.enable_direct(CLIP_DISTANCE0)
        assert isinstance(linked.program, moderngl.Program)
        mesh.draw(linked.program)
        if clips:
            self._gpu.ctx.disable_direct(CLIP_DISTANCE0)
        target.scissor = None  # type: ignore[assignment]  # or it would cut what is cleared next
        linked.report((mesh.triangle_count,), partial(_attachments, target))


def _attachments(target: moderngl.Framebuffer) -> dict[str, object]:
    items = enumerate([*target.color_attachments, target.depth_attachment])
    return {f"attachment {number}": item for number, item in items}
