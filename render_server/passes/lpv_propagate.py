"""Propagation: light goes from cell to cell (METHOD 5)."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, Uniform
from render_server.passes.light_volume import LightVolume, StepWeights
from render_server.passes.voxel_store import bind_storage

TILED = Path(__file__).with_name("lpv_propagate.comp.glsl")
PLAIN = Path(__file__).with_name("lpv_propagate_plain.comp.glsl")
FUSED_STEPS = 2  # a dispatch: the rim of two cells still fits 32 KB of shared memory


class LpvPropagatePass:
    """Steps of one light volume; `tiled`: in shared memory, several a dispatch (default on a GPU), else singly."""

    def __init__(self, gpu: GpuContext, *, tiled: bool | None = None) -> None:
        self._tiled = not gpu.is_software if tiled is None else tiled
        self._programs = (
            {count: ComputeProgram(gpu, TILED, {"FUSED": count}) for count in (1, FUSED_STEPS)}
            if self._tiled
            else {1: ComputeProgram(gpu, PLAIN)}
        )

    def run(
        self, volume: LightVolume, weights: StepWeights, steps: int, transmitted: moderngl.Buffer | None
    ) -> None:
        """Make `steps` steps; without `transmitted` nothing blocks."""
        blocking = transmitted if transmitted is not None else volume.total
        uniforms: dict[str, Uniform] = {
            "cells": volume.cells,
            "has_geometry": transmitted is not None,
            "transfer": weights.transfer,
            "sideways": weights.sideways,
        }
        channels = 3 if self._tiled else 1  # the plain step walks over them
        threads = (volume.cells, volume.cells, channels * volume.cells)
        while steps > 0:
            count = max(count for count in self._programs if count <= steps)
            bind_storage({8: volume.state, 9: volume.next_state, 10: volume.total, 11: blocking})
            self._programs[count].run(threads, **uniforms)
            volume.swap()
            steps -= count

    def release(self) -> None:
        """Free the programs."""
        for program in self._programs.values():
            program.release()
