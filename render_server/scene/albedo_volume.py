"""Albedo of the real scene by position, averaged over time, for surfaces out of view (docs/method.md 2)."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

CELLS = 64  # per edge of the cube: 5 cm in a room of 3 m, finer than bounce light resolves
MARGIN = 1.1  # of the cube over the scene's bounds
MAX_WEIGHT = 200.0  # samples a cell keeps: as many new ones replace an outdated albedo
ALBEDO_RANGE = (0.02, 0.95)
MEAN_ALBEDO = 0.5  # before any observation


class AlbedoVolume:
    """Sums of measured radiance and of irradiance in the cells of a cube: albedo = pi sum B / sum E.

    `version` rises with every change. `origin` is the cube's lowest corner and `edge` its edge, world metres.
    """

    def __init__(self) -> None:
        self.version = 0
        self.origin = np.zeros(3)
        self.edge = 0.0
        self._sums = np.zeros((0, 7))

    def observe(
        self,
        bounds: tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]],
        position: Float[np.ndarray, "k 3"],
        measured: Float[np.ndarray, "k 3"],
        irradiance: Float[np.ndarray, "k 3"],
    ) -> None:
        """Accumulates the unshadowed, unclipped pixels of diffuse surfaces in one picture.

        Args:
            bounds: least and greatest coordinates of the real scene, world metres; if they leave the cube, all
                samples are dropped and a new cube is placed.
            position: world metres.
            measured: linear radiance B, camera units.
            irradiance: total irradiance E there, camera units.
        """
        self._place_cube(*bounds)
        cell, inside = self._cells(position)
        known = inside & (irradiance > 0).all(axis=1) & np.isfinite(measured).all(axis=1)
        values = np.column_stack([measured, irradiance, np.ones(len(measured))])[known]
        new = np.stack([np.bincount(cell[known], column, CELLS**3) for column in values.T], axis=1)
        kept = np.minimum(1, np.maximum(MAX_WEIGHT - new[:, 6], 0) / np.maximum(self._sums[:, 6], 1e-9))
        self._sums = self._sums * kept[:, None] + new
        self.version += 1

    def _place_cube(self, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"]) -> None:
        if self.edge > 0 and (low >= self.origin).all() and (high <= self.origin + self.edge).all():
            return
        self.edge = MARGIN * float(np.max(high - low))
        self.origin = (low + high - self.edge) / 2
        self._sums = np.zeros((CELLS**3, 7))

    def _cells(
        self, position: Float[np.ndarray, "k 3"]
    ) -> tuple[Int64[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
        place = np.floor((position - self.origin) / self.edge * CELLS)
        inside = np.asarray(((place >= 0) & (place < CELLS)).all(axis=1))
        x, y, z = np.where(inside[:, None], place, 0).astype(np.int64).T
        return (z * CELLS + y) * CELLS + x, inside

    def filled(self) -> Float32[np.ndarray, "z y x 3"]:
        """Returns the albedo of every cell; empty cells take it from the finest coarser level with samples."""
        levels = [self._sums.reshape((CELLS,) * 3 + (7,))]
        while len(levels[-1]) > 1:
            half = len(levels[-1]) // 2
            levels.append(levels[-1].reshape(half, 2, half, 2, half, 2, 7).sum(axis=(1, 3, 5)))
        albedo = np.full((1, 1, 1, 3), MEAN_ALBEDO)
        for sums in reversed(levels):
            factor = len(sums) // len(albedo)
            coarse = albedo.repeat(factor, 0).repeat(factor, 1).repeat(factor, 2)
            found = np.pi * sums[..., :3] / np.maximum(sums[..., 3:6], 1e-12)
            albedo = np.where(sums[..., 6:] > 0, np.clip(found, *ALBEDO_RANGE), coarse)
        return np.asarray(albedo, np.float32)
