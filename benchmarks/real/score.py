"""Figures of a relit table against its photograph, with the thing itself masked out."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.sensors import srgb_bytes
from deltalight.benchmarks.quality.energy import Change, energy_ratios
from deltalight.benchmarks.quality.metrics import Mask, decibels
from deltalight.benchmarks.quality.regions import Linear, Regions

SMOOTH_PX = 3.0
CHANGE_CODES = 4.0
"""A pixel is changed if the photographs' smoothed difference is more: their noise, smoothed so, stays below 1."""


@dataclass(frozen=True)
class Figures:
    """PSNR over the table and over its changed part, dB; light taken and added, as fractions of the photograph's."""

    table_psnr_db: float
    changed_psnr_db: float
    taken: float
    added: float


def changed_part(truth: Linear, plate: Linear, table: Mask) -> Mask:
    """Returns the pixels of the table whose light the thing changes; both pictures are linear, equally exposed."""
    difference = srgb_bytes(truth).astype(np.float32) - srgb_bytes(plate)
    smooth = cv2.GaussianBlur(difference * table[..., None], (0, 0), SMOOTH_PX)
    inside = cv2.GaussianBlur(table.astype(np.float32), (0, 0), SMOOTH_PX)
    mean = smooth / np.maximum(inside, 1e-3)[..., None]
    return np.asarray(table & (np.abs(mean).max(axis=2) > CHANGE_CODES))


def score(result: Linear, truth: Linear, plate: Linear, table: Mask, changed: Mask) -> Figures:
    """Compares a result with the photograph `truth`; `plate` is the empty table. All are linear, equally exposed."""
    regions = Regions(changed, table, np.zeros_like(table))
    energy = energy_ratios(result, plate, [Change(plate, truth, regions)])
    return Figures(
        psnr_db(result, truth, table), psnr_db(result, truth, changed), energy.darkening, energy.brightening
    )


def psnr_db(result: Linear, truth: Linear, mask: Mask) -> float:
    """Returns the PSNR of 8-bit codes over a mask, dB; nan where it is empty."""
    codes: Float32[np.ndarray, "h w 3"] = srgb_bytes(result).astype(np.float32) - srgb_bytes(truth)
    return decibels(float(np.square(codes[mask]).mean())) if mask.any() else np.nan


def means(figures: list[Figures]) -> Figures:
    """Returns the mean of each figure over pictures; what is not defined in one is left out."""
    values = np.array(
        [(each.table_psnr_db, each.changed_psnr_db, each.taken, each.added) for each in figures]
    )
    table, changed, taken, added = (float(np.nanmean(column)) for column in values.T)
    return Figures(table, changed, taken, added)
