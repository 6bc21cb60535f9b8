"""Measured BRDFs in Cornell's text format, as linear R G B."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from deltalight.protocol.errors import DeltalightError

BRDF_SUFFIX = ".brdf"
_LARGEST_BYTES = 64 << 20
_LARGEST = 1e6  # of a BRDF, 1/sr, and of all else in such a file
_LEAST_SAMPLES = 100
_WAVELENGTHS = np.arange(400.0, 701.0, 10.0)  # nm
# CIE standard illuminant D65, relative power at these wavelengths (ISO/CIE 11664-2).
_D65 = np.loadtxt(
    [
        "82.75 91.49 93.43 86.68 104.87 117.01 117.81 114.86 115.92 108.81 109.35 107.80 104.79 107.69 104.41 104.05"
        " 100.00 96.33 95.79 88.69 90.01 89.60 87.70 83.29 83.70 80.03 80.21 82.28 78.28 69.72 71.61"
    ]
)
_SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
# Terms of the CIE 1931 observer (Wyman et al. 2013, table 1): factor, peak (nm), slopes below and above it (1/nm).
_OBSERVER = (
    ((1.056, 599.8, 0.0264, 0.0323), (0.362, 442.0, 0.0624, 0.0374), (-0.065, 501.1, 0.0490, 0.0382)),
    ((0.821, 568.8, 0.0213, 0.0247), (0.286, 530.9, 0.0613, 0.0322)),
    ((1.217, 437.0, 0.0845, 0.0278), (0.681, 459.0, 0.0385, 0.0725)),
)


@dataclass(frozen=True, eq=False)
class BrdfMeasurements:
    """Samples of an isotropic BRDF: unit directions about the normal z; values, 1/sr, linear R G B, at least 0."""

    light: Float64[np.ndarray, "n 3"]
    view: Float64[np.ndarray, "n 3"]
    values: Float64[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.values)

    def subset(self, chosen: Bool[np.ndarray, " n"]) -> "BrdfMeasurements":
        """Returns some of the samples."""
        return BrdfMeasurements(self.light[chosen], self.view[chosen], self.values[chosen])


def read_brdf(path: Path) -> BrdfMeasurements:
    """Reads a `.brdf` file: comments behind `#`, the number of wavelengths, the wavelengths (nm), and rows.

    A row is theta and phi of the light, theta and phi of the viewer (rad), and the BRDF at each wavelength, 1/sr.

    Raises:
        DeltalightError: it cannot be read, or is no such file.
    """
    numbers = _numbers(path)
    count = int(numbers[0]) if len(numbers) and 2 <= numbers[0] <= 1000 else 0
    wavelengths, rows = numbers[1 : 1 + count], numbers[1 + count :]
    if count == 0 or len(wavelengths) < count or len(rows) % (4 + count) or (np.diff(wavelengths) <= 0).any():
        raise DeltalightError(
            f"{path.name} is not a complete .brdf file (wavelengths in nm, then rows of four angles and a value"
            " for each wavelength); get it again."
        )
    if wavelengths[0] > 450 or wavelengths[-1] < 650:
        raise DeltalightError(
            f"{path.name} was measured from {wavelengths[0]:g} to {wavelengths[-1]:g} nm, which gives no colour; "
            "it needs 450 to 650 nm."
        )
    table = rows.reshape(-1, 4 + count)
    light, view = _direction(table[:, :2]), _direction(table[:, 2:4])
    above = (light[:, 2] > 1e-3) & (view[:, 2] > 1e-3)
    if above.sum() < _LEAST_SAMPLES:
        raise DeltalightError(
            f"{path.name} has {above.sum()} samples above the surface; a fit needs at least {_LEAST_SAMPLES}."
        )
    values = np.maximum(table[:, 4:] @ _rgb_from(wavelengths).T, 0)
    return BrdfMeasurements(light, view, values).subset(above)


def _numbers(path: Path) -> Float64[np.ndarray, " n"]:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise DeltalightError(
                f"{path.name} is larger than {_LARGEST_BYTES >> 20} MB; that is not a .brdf file."
            )
        lines = path.read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise DeltalightError(f"{path} cannot be read ({error.strerror}); give a .brdf file.") from error
    try:
        words = " ".join(line for line in lines if not line.lstrip().startswith("#")).split()
        numbers = np.array(words, np.float64)
    except ValueError as error:
        raise DeltalightError(
            f"{path.name} holds something other than numbers; it is not a .brdf file."
        ) from error
    if not (np.abs(numbers) < _LARGEST).all():  # nor a number
        raise DeltalightError(
            f"{path.name} has a value that is not finite or beyond {_LARGEST:g}; measure or export it again."
        )
    return numbers


def _direction(angles: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    theta, phi = angles.T
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


def _rgb_from(wavelengths: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "3 n"]:
    """Returns the matrix from a spectrum to linear sRGB under D65; a white spectrum is (1, 1, 1)."""
    observer = np.array([sum(_bump(*term) for term in terms) for terms in _OBSERVER])
    weights = _SRGB_FROM_XYZ @ (observer * _D65)
    weights /= weights.sum(axis=1, keepdims=True)
    resampled = np.stack(
        [np.interp(_WAVELENGTHS, wavelengths, each) for each in np.eye(len(wavelengths))], axis=1
    )
    return np.asarray(weights @ resampled)


def _bump(factor: float, peak: float, below: float, above: float) -> Float64[np.ndarray, "31"]:
    from_peak = _WAVELENGTHS - peak
    return np.asarray(factor * np.exp(-0.5 * (from_peak * np.where(from_peak < 0, below, above)) ** 2))
