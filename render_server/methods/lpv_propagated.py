"""A light propagation volume and the steps that it takes, by whichever kernels serve its size (docs/method.md 5)."""

import math

import moderngl

from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.methods.lpv_cells import release_held
from deltalight.render_server.passes.lpv import (
    LightVolume,
    LpvPropagate,
    LpvStart,
    LpvStartChange,
    lobe_weights,
    medium_bindings,
    moment_weights,
)
from deltalight.render_server.passes.lpv_small import HalfSteps, SmallVolume

STEPS_OF_A_BOUNCE = 1 / 4
"""Fraction of the steps: V_rho starts with the light of V_mu, and each bounce goes on where the one before ended."""


class Propagated:
    """A light volume and its steps."""

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, cells: int, steps: int) -> None:
        has_moments = settings.resolved_propagation == "moments"
        self._weights, self._steps = moment_weights(cells) if has_moments else lobe_weights(), steps
        self.light = LightVolume(gpu, cells)
        self._start = LpvStart(gpu)
        self._start_change = LpvStartChange(gpu)
        self._propagate = LpvPropagate(gpu)
        self._in_place = self._propagate.is_in_place(cells, steps)
        self._half_step = self._in_place and self._propagate.starts_with_half_step
        self._small = SmallVolume(gpu) if SmallVolume.serves(gpu, cells, in_place=self._in_place) else None

    def run(
        self,
        through: moderngl.Texture3D | None,
        injected: moderngl.Buffer,
        more: moderngl.Buffer | None = None,
    ) -> LightVolume:
        """Propagates the light of one or two injected sums, added up; without `through` nothing blocks it."""
        if self._small is not None:
            self._small.start(self.light, self._half_steps(self._small, self._steps, through), injected, more)
            return self.light
        self._start.run(self.light, self._medium(through), injected, more, half_step=self._half_step)
        return self._go(self._steps, through)

    def run_change(
        self,
        before: LightVolume,
        change: moderngl.Buffer,
        through_real: moderngl.Texture3D | None,
        through: moderngl.Texture3D | None,
    ) -> LightVolume:
        """Propagates what objects change of the light `before`."""
        if self._small is not None:
            half_steps = self._half_steps(self._small, self._steps, through)
            self._small.start_change(self.light, half_steps, before, change, through_real)
            return self.light
        self._start_change.run(
            self.light,
            before,
            change,
            self._medium(through),
            through_real,
            in_place=self._in_place,
            half_step=self._half_step,
        )
        return self._go(self._steps, through)

    @property
    def _further(self) -> int:
        """Steps of a bounce."""
        return math.ceil(STEPS_OF_A_BOUNCE * self._steps)

    def go_on(self, through: moderngl.Texture3D | None) -> LightVolume:
        """Propagates on by STEPS_OF_A_BOUNCE."""
        return self._go(self._further, through)

    def half_steps_of_a_bounce(self, through: moderngl.Texture3D | None) -> HalfSteps | None:
        """What `go_on` would do, for whoever adds the bounce; None: that is another dispatch."""
        return None if self._small is None else self._half_steps(self._small, self._further, through)

    def _half_steps(self, small: SmallVolume, count: int, through: moderngl.Texture3D | None) -> HalfSteps:
        return HalfSteps(small, self._medium(through), count)

    def _go(self, steps: int, through: moderngl.Texture3D | None) -> LightVolume:
        self._propagate.run(self.light, self._medium(through), steps, in_place=self._in_place)
        return self.light

    def _medium(self, through: moderngl.Texture3D | None) -> Bindings:
        return medium_bindings(self.light.cells, self._weights, through)

    def release(self) -> None:
        """Frees the GL objects."""
        release_held(self)
