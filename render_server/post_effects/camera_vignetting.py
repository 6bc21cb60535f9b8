"""A camera's vignetting on the virtual part ([D] 6.2), measured on the board's paper as the camera moves.

A patch of paper sends the same light wherever the picture shows it, so each is compared with itself: how unevenly
light falls on the board does not matter. The logarithm of the falloff is a polynomial in the squared distance from
the principal point.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame, decode_lut, linear_color

MOST_FRAMES, LEAST_FRAMES = 24, 5
LEAST_STEP = 0.03
"""Of the picture's half diagonal: how far the paper must have moved in it for another frame to count."""
LATTICE = np.linspace(0.1, 0.9, 5)
"""Where a patch is read, as fractions of its edges."""
CODES = (4, 251)
MOST_SPREAD = 0.1
"""Of a patch's mean, standard deviation: something else is on it."""
OUTLIER_DEVIATIONS = 3.0
SIGNIFICANT = 3.0
"""Standard errors by which the falloff must differ from none."""


@dataclass(frozen=True, eq=False)
class Vignetting:
    """Factors on light by distance from the principal point, 1 where the paper was on average.

    `logarithm` holds the coefficients of r^2 and r^4, r in half diagonals of the picture; beyond `reach`, the
    farthest r where the paper was seen, the factor stays as it is there.
    """

    logarithm: Float64[np.ndarray, " 2"]
    reach: float
    mean: float

    def factors(self, camera: CameraModel) -> Float32[np.ndarray, "h w"]:
        """Returns the factor at each pixel."""
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        r = _radii(camera, np.stack([columns, rows], axis=-1))
        logarithm = _powers(np.minimum(r, self.reach)) @ self.logarithm - self.mean
        return np.asarray(np.exp(logarithm), np.float32)


@dataclass(frozen=True, eq=False)
class _Seen:
    """What one frame shows of the paper: by patch, its radius in the picture and the logarithm of its radiance."""

    centre: Float64[np.ndarray, " 2"]
    patches: Float64[np.ndarray, " n"]
    radii: Float64[np.ndarray, " n"]
    logarithm: Float64[np.ndarray, " n"]


class PaperVignetting:
    """Learns a camera's vignetting from frames whose exposure is known, as the board's paper moves in the picture."""

    def __init__(self) -> None:
        self._frames: list[_Seen] = []
        self.model: Vignetting | None = None

    def observe(self, frame: ViewFrame) -> None:
        """Takes a frame, if the paper is elsewhere in it than in the one before."""
        if len(self._frames) >= MOST_FRAMES or frame.exposure_s is None:
            return
        seen = _paper(frame)
        if seen is None:
            return
        step = LEAST_STEP * _half_diagonal(frame.camera)
        if self._frames and np.linalg.norm(seen.centre - self._frames[-1].centre) < step:
            return
        self._frames.append(seen)
        if len(self._frames) >= LEAST_FRAMES:
            self.model = _fitted(self._frames)


def _fitted(frames: list[_Seen]) -> Vignetting | None:
    """Fits the falloff, twice because of outliers; None if it is not significant."""
    patches, radii, logarithm = (
        np.concatenate([getattr(each, name) for each in frames]) for name in ("patches", "radii", "logarithm")
    )
    kept = np.ones(len(radii), bool)
    for _ in range(2):
        names = patches[kept].astype(int)
        x, y = (_without_patch_means(each[kept], names) for each in (_powers(radii), logarithm))
        normal = x.T @ x
        if np.linalg.cond(normal) > 1e9:
            return None
        found = np.linalg.solve(normal, x.T @ y)
        misfit = y - x @ found
        deviation = max(1.4826 * float(np.median(np.abs(misfit))), 1e-6)
        kept[kept] = np.abs(misfit) <= OUTLIER_DEVIATIONS * deviation
    reach = float(radii[kept].max())
    at_reach = _powers(np.array(reach))
    error = np.sqrt(at_reach @ np.linalg.solve(normal, at_reach)) * deviation
    if abs(float(at_reach @ found)) <= SIGNIFICANT * error:
        return None
    return Vignetting(found, reach, float((_powers(radii[kept]) @ found).mean()))


def _without_patch_means(
    values: Float64[np.ndarray, "n ..."], names: np.ndarray
) -> Float64[np.ndarray, "n ..."]:
    """Returns values less the mean over all frames of their patch, whose light is not known."""
    table = values.reshape(len(values), -1)
    count = np.maximum(np.bincount(names), 1)
    means = np.stack([np.bincount(names, column) / count for column in table.T], axis=1)
    return np.asarray((table - means[names]).reshape(values.shape))


def _paper(frame: ViewFrame) -> _Seen | None:
    """Reads the patches of the board's paper that a frame shows well; None if it shows none."""
    if frame.board is None or frame.pose is None:
        return None
    quads = frame.board.paper_patches()
    if not len(quads):
        return None
    u, v = (each.reshape(-1, 1) for each in np.meshgrid(LATTICE, LATTICE))
    corner, right, down = quads[:, 0], quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0]
    points = corner[:, None] + u * right[:, None] + v * down[:, None]
    from_world = np.linalg.inv(frame.pose.world_from_camera)
    seen = points @ from_world[:3, :3].T + from_world[:3, 3]
    pixels = frame.camera.project(seen.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    size = np.array([frame.camera.width, frame.camera.height])
    inside = (seen[..., 2] > 0) & np.all((pixels >= 0) & (pixels <= size - 1), axis=-1)
    columns, rows = np.moveaxis(np.where(inside[..., None], np.rint(pixels), 0).astype(int), -1, 0)
    codes = frame.color[rows, columns]
    value = linear_color(frame, codes).mean(axis=-1, dtype=np.float64)
    mean = value.mean(axis=1)
    used = inside.all(axis=1) & (codes >= CODES[0]).all(axis=(1, 2)) & (codes <= CODES[1]).all(axis=(1, 2))
    used &= value.std(axis=1) <= MOST_SPREAD * mean
    if not used.any():
        return None
    middles = pixels[used].mean(axis=1)
    radii = _radii(frame.camera, middles)
    return _Seen(middles.mean(axis=0), np.nonzero(used)[0].astype(float), radii, np.log(mean[used]))


def _half_diagonal(camera: CameraModel) -> float:
    return float(np.hypot(camera.width, camera.height) / 2)


def _radii(camera: CameraModel, pixels: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n"]:
    """Returns distances from the principal point, in half diagonals of the picture."""
    return np.asarray(np.linalg.norm(pixels - camera.matrix[:2, 2], axis=-1) / _half_diagonal(camera))


def _powers(r: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n 2"]:
    return np.stack([r**2, r**4], axis=-1)


def vignetted(
    color: UInt8[np.ndarray, "h w 3"],
    coverage: Float32[np.ndarray, "h w"],
    factors: Float32[np.ndarray, "h w"],
    frame: ViewFrame,
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a picture whose virtual part darkens as the camera's does; other pixels are the same to the bit."""
    covered = coverage > 0
    if not covered.any():
        return color
    lut = decode_lut(frame.response)
    factor = 1 + np.clip(coverage[covered], 0, 1)[:, None] * (factors[covered][:, None] - 1)
    light = lut[color[covered], np.arange(3)] * factor
    result = color.copy()
    coded = [np.interp(light[:, channel], lut[:, channel], np.arange(256)) for channel in range(3)]
    result[covered] = np.rint(np.stack(coded, axis=-1))
    return result
