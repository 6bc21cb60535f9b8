"""Measured materials as sums of Gaussians: model, integrals and table for shaders (docs/method.md 6.7)."""

import math
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np
from jaxtyping import Float32, Float64

MOST_LOBES = 4
RISE_TERMS = 6  # Bernstein polynomials of degree 5, which Schlick's Fresnel term is
COSINES = 16  # at which the shaders' table holds the lobes' albedo
TABLE_TEXELS = 1 + MOST_LOBES * (1 + RISE_TERMS + COSINES)  # common/measured.glsl
CONE_ENERGY = 0.85  # of a lobe's energy, in the cone that stands for it (brdf.glsl, specular_half_angle)
_LEAST_COSINE = 0.01
_SIDE = 48  # samples of a lobe's integral: squared
# x^i of Bernstein polynomial j: row i, column j.
_POWERS = np.array(
    [
        [(-1) ** (i - j) * comb(5, i) * comb(i, j) if i >= j else 0 for j in range(RISE_TERMS)]
        for i in range(RISE_TERMS)
    ],
    np.float64,
)


def rise_basis(v_dot_h: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 6"]:
    """Returns the Bernstein polynomials of degree 5 of 1 - v.h, which lobes' weights are made of."""
    x = 1 - np.clip(v_dot_h, 0, 1)[:, None]
    terms = np.arange(RISE_TERMS)
    binomials = np.array([comb(5, int(term)) for term in terms], np.float64)
    return np.asarray(binomials * x**terms * (1 - x) ** (5 - terms))


def lobe_density(
    light: Float64[np.ndarray, "n 3"], view: Float64[np.ndarray, "n 3"], sigma: float
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Returns a lobe of weight 1, 1/sr, and v.h, for unit directions about the normal z.

    The half-vector's Gaussian exp((n.h - 1) / sigma^2) has integral 1; it is divided by 4 (v.h) max(n.l, n.v)
    (Ashikhmin and Shirley 2000), so that the lobe reflects at most its weight.
    """
    half = light + view
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    v_dot_h = np.clip((view * half).sum(axis=1), 1e-3, 1)
    # 1 - n.h, without the difference of nearly equal numbers
    off = 0.5 * (half[:, 0] ** 2 + half[:, 1] ** 2 + (1 - half[:, 2]) ** 2)
    gaussian = np.exp(-off / sigma**2) / (2 * np.pi * sigma**2 * -np.expm1(-1 / sigma**2))
    return gaussian / (4 * v_dot_h * np.maximum(np.maximum(light[:, 2], view[:, 2]), 1e-3)), v_dot_h


@dataclass(frozen=True, eq=False)
class GaussianBrdf:
    """An isotropic reciprocal BRDF: a diffuse base and Gaussians of the half-vector; linear R G B.

    `sigmas` are the Gaussians' widths (rad of the half-vector), `weights` the coefficients of `rise_basis`: how much
    each reflects at which angle between view and half-vector. All are at least 0.
    """

    diffuse: Float64[np.ndarray, "3"]  # albedo of the base
    sigmas: Float64[np.ndarray, " k"]
    weights: Float64[np.ndarray, "k 6 3"]

    def evaluate(
        self, light: Float64[np.ndarray, "n 3"], view: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Returns the BRDF, 1/sr, for unit directions above the surface, whose normal is z."""
        total = np.tile(self.diffuse / np.pi, (len(light), 1))
        for sigma, weights in zip(self.sigmas, self.weights, strict=True):
            density, v_dot_h = lobe_density(light, view, float(sigma))
            total += density[:, None] * (rise_basis(v_dot_h) @ weights)
        return total

    def lobe_albedo(self, cosine: float) -> Float64[np.ndarray, "k 3"]:
        """Returns what each lobe reflects of light from everywhere towards a viewer at that cosine."""
        view = np.array([math.sqrt(1 - cosine * cosine), 0.0, cosine])
        return np.array(
            [
                _lobe_albedo(view, float(sigma), weights)
                for sigma, weights in zip(self.sigmas, self.weights, strict=True)
            ]
        ).reshape(-1, 3)

    @cached_property
    def lobe_albedos(self) -> Float64[np.ndarray, "16 k 3"]:
        """`lobe_albedo` at even steps of the cosine, 0..1."""
        cosines = np.maximum(np.linspace(0, 1, COSINES), _LEAST_COSINE)
        return np.array([self.lobe_albedo(float(cosine)) for cosine in cosines])

    @property
    def greatest_albedo(self) -> Float64[np.ndarray, "3"]:
        """The most that is reflected of light from everywhere, over all views."""
        return np.asarray(self.diffuse + self.lobe_albedos.sum(axis=1).max(axis=0))

    @property
    def hemispherical_albedo(self) -> Float64[np.ndarray, "3"]:
        """The fraction reflected of light from everywhere, in all directions."""
        cosines = np.linspace(0, 1, COSINES)
        summed = self.lobe_albedos.sum(axis=1)
        return np.asarray(self.diffuse + np.trapezoid(2 * cosines[:, None] * summed, cosines, axis=0))

    @property
    def half_angles(self) -> Float64[np.ndarray, " k"]:
        """Half-angle (rad) of the cone about the mirror direction that holds 85 % of each lobe."""
        return np.minimum(2 * self.sigmas * math.sqrt(-2 * math.log(1 - CONE_ENERGY)), 0.45 * np.pi)

    @property
    def roughness(self) -> float:
        """Perceptual roughness of the GGX lobe whose cone is the mean of the lobes'; 1 without lobes."""
        reflected = self.lobe_albedos[3 * COSINES // 4].mean(axis=1)
        if not reflected.sum() > 0:
            return 1.0
        angle = float((reflected * self.half_angles).sum() / reflected.sum())
        return float(
            np.clip(math.sqrt(math.tan(angle / 2) / math.sqrt(CONE_ENERGY / (1 - CONE_ENERGY))), 0, 1)
        )

    def scaled_to_conserve(self) -> "GaussianBrdf":
        """Returns it with every channel that would reflect more light than arrives scaled down to all of it."""
        factor = 1 / np.maximum(self.greatest_albedo, 1.0)
        return GaussianBrdf(self.diffuse * factor, self.sigmas, self.weights * factor)

    def table_row(self) -> Float32[np.ndarray, "93 4"]:
        """Returns its row of the shaders' table (common/measured.glsl).

        (diffuse albedo, number of lobes); of each lobe (sigma, half-angle, 0, 0), the coefficients of powers of
        1 - v.h, and its albedo at even steps of n.v.
        """
        row = np.zeros((TABLE_TEXELS, 4), np.float32)
        row[0] = *self.diffuse, len(self.sigmas)
        for k, weights in enumerate(self.weights):
            lobe = row[1 + k * (1 + RISE_TERMS + COSINES) :]
            lobe[0, :2] = self.sigmas[k], self.half_angles[k]
            lobe[1 : 1 + RISE_TERMS, :3] = _POWERS @ weights
            lobe[1 + RISE_TERMS :][:COSINES, :3] = self.lobe_albedos[:, k]
        return row


def _lobe_albedo(
    view: Float64[np.ndarray, "3"], sigma: float, weights: Float64[np.ndarray, "6 3"]
) -> Float64[np.ndarray, "3"]:
    """Integrates a lobe over the directions that its half-vectors reflect the view to."""
    even = (np.arange(_SIDE) + 0.5) / _SIDE
    u, turn = (each.ravel() for each in np.meshgrid(even, 2 * np.pi * even))
    z = 1 + sigma**2 * np.log1p(u * np.expm1(-1 / sigma**2))
    level = np.sqrt(np.maximum(1 - z * z, 0))
    half = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
    v_dot_h = half @ view
    n_dot_l = 2 * v_dot_h * z - view[2]
    seen = np.where((n_dot_l > 0) & (v_dot_h > 0), n_dot_l / np.maximum(n_dot_l, view[2]), 0)
    return np.asarray((seen[:, None] * (rise_basis(v_dot_h) @ weights)).mean(axis=0))
