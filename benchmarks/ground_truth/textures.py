"""Procedural albedo pictures (linear RGB) of the demo room: wood and plaster, from smooth noise."""

from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float32

WOOD_LIGHT = np.array([0.52, 0.315, 0.165], np.float32)
WOOD_DARK = np.array([0.30, 0.155, 0.07], np.float32)


def smooth_noise(
    rng: np.random.Generator, height: int, width: int, cells_y: int, cells_x: int
) -> Float32[np.ndarray, "h w"]:
    """Returns noise of unit variance with features of height/cells_y by width/cells_x pixels."""
    coarse = rng.standard_normal((cells_y + 1, cells_x + 1)).astype(np.float32)
    fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine / fine.std())


def wood(seed: int, height: int, width: int, planks: int) -> Float32[np.ndarray, "h w 3"]:
    """Returns a table of `planks` boards with the grain along the rows, each with its own rings, tint and seam."""
    rng = np.random.default_rng(seed)
    edges = np.linspace(0, height, planks + 1).round().astype(int)
    strips = [_plank(rng, int(b - a), width) for a, b in pairwise(edges)]
    return np.concatenate(strips)


def _plank(rng: np.random.Generator, height: int, width: int) -> Float32[np.ndarray, "h w 3"]:
    warp = smooth_noise(rng, height, width, 3, 6) + 0.25 * smooth_noise(rng, height, width, 8, 20)
    across = np.linspace(0, 1, height, dtype=np.float32)[:, None] + np.float32(rng.uniform(0, 3))
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (3.5 * across + 0.55 * warp))
    fibre = smooth_noise(rng, height, width, height // 2, max(width // 90, 1))
    darkness = np.clip(0.25 + 0.38 * rings + 0.10 * fibre, 0, 1)[..., None]
    tint = np.float32(rng.uniform(0.88, 1.08))
    color = tint * (WOOD_LIGHT * (1 - darkness) + WOOD_DARK * darkness)
    color[: max(height // 90, 1)] *= 0.45  # the seam between two boards
    return np.ascontiguousarray(color, np.float32)


def plaster(
    seed: int, height: int, width: int, color: tuple[float, float, float]
) -> Float32[np.ndarray, "h w 3"]:
    """Returns a painted wall of mean albedo `color` with faint roller marks."""
    rng = np.random.default_rng(seed)
    marks = smooth_noise(rng, height, width, 9, 14) + 0.8 * smooth_noise(rng, height, width, 120, 160)
    return np.asarray(color, np.float32) * (1 + 0.018 * marks[..., None]).astype(np.float32)
