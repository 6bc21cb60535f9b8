"""Relit frame -> picture: composition, views for people who look, readback."""

from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from protocol.scene_method import Output
from render_server.gpu.context import GpuContext
from render_server.gpu.readback import AsyncReadback
from render_server.passes.composite import CompositePass
from render_server.passes.views import ViewPasses
from render_server.relighting import RelitFrame


class Composer:
    """Owns the composite's textures and reads them back."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._pass: CompositePass | None = None
        self._size: tuple[int, int] | None = None
        self._readback = AsyncReadback(gpu)
        self._views = ViewPasses(gpu)

    def start(self, relit: RelitFrame, output: Output, *, with_linear: bool) -> None:
        """Compose and begin to read back; `finish` gives the oldest picture that was started."""
        composite = self._pass_for(relit.input.view.size)
        needs_linear = with_linear or output.view in ("effects", "delta")
        uniforms: dict[str, Any] = {
            **relit.input.view.uniforms(),
            **relit.input.surface_uniforms,
            **relit.uniforms,
            "filmic": output.tone == "aces",
            "store_linear": needs_linear,
            "whole": needs_linear or output.tone == "aces",
        }
        with relit.timers.measure("composite"):
            relit.input.bind_geometry()
            composite.run(relit.input.picture, relit.layers, uniforms)
        self._show_view(composite, relit, output.view)
        with relit.timers.measure("readback"):
            self._readback.push(composite.code, "u1")
            if with_linear:
                self._readback.push(composite.linear, "f2")

    def finish(
        self, *, with_linear: bool
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"] | None]:
        """Picture in camera codes, and linear if it was started so; waits only if the GPU is not done with it."""
        color = np.ascontiguousarray(self._readback.pop()[..., :3])
        linear = self._readback.pop()[..., :3].astype(np.float32) if with_linear else None
        return color, linear

    def _show_view(self, composite: CompositePass, relit: RelitFrame, view: str) -> None:
        """Replace the picture by a look inside, if one is asked for."""
        picture, layers = relit.input.picture, relit.layers
        if view == "composite":
            return
        with relit.timers.measure("view"):
            if view == "volume":
                uniforms = relit.input.view.uniforms()
                self._views.volume(composite.code, picture, layers.pyramid, layers.placement, uniforms)
            elif view == "rsm":
                self._views.shadow_maps(composite.code, layers.table)
            else:
                self._views.change(
                    composite.code, picture, composite.linear, layers.matte, effects=view == "effects"
                )

    def _pass_for(self, size: tuple[int, int]) -> CompositePass:
        if self._pass is None or self._size != size:
            if self._pass is not None:
                self._pass.release()
            self._pass, self._size = CompositePass(self._gpu, size), size
        return self._pass

    def release(self) -> None:
        """Free the GL objects."""
        self._readback.release()
        self._views.release()
        if self._pass is not None:
            self._pass.release()
