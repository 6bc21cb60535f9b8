"""A BSDF for Mitsuba of surfaces under clear coats and sheens; imported where Mitsuba is.

It has the layers of KHR_materials_clearcoat and KHR_materials_sheen as the renderer (docs/method.md 4.12) and
none of its fits but the published one of the fibres' shadowing: integrals are by quadrature here, and the base and
the coat are those of energy_keeping.py.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Self

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.ground_truth.energy_keeping import (
    ANGLES,
    DEGREE,
    LEAST_ALPHA,
    QUADRATURE,
    Numbers,
    fresnel,
    lobe_albedo,
    smith_visibility,
)
from deltalight.benchmarks.ground_truth.energy_keeping_bsdf import (
    GlossySurface,
    LobeEnergy,
    bsdf_class,
    polynomial,
    polynomial_place,
)
from deltalight.benchmarks.ground_truth.parts import Triple, rgb

PLUGIN = "coated"
COAT_F0 = 0.04
COAT_SAMPLES = 0.35
"""Of all samples, those of the coat's lobe."""
LEAST_SHEEN_ALPHA = 0.01
_FIBRES = np.array(
    [[21.5473, 3.82987, 0.19823, -1.9776, -4.32054], [25.3245, 3.32435, 0.16801, -1.27393, -4.85967]]
)
"""Smith's lambda for the roughest and the smoothest fibres (Estevez & Kulla 2017)."""
_registered: set[str] = set()  # variants


def coated(
    base_color: Triple,
    *,
    roughness: float,
    metallic: float,
    coat: tuple[float, float],
    sheen: Triple,
    sheen_roughness: float,
) -> dict[str, Any]:
    """Returns a surface under a coat (factor, roughness) over a sheen, in glTF's terms."""
    variant = str(mi.variant())
    if variant not in _registered:
        mi.register_bsdf(PLUGIN, bsdf_class(CoatedSurface))
        _registered.add(variant)
    values = {"roughness": roughness, "metallic": metallic, "specular": 0.5}
    over = {"coat": coat[0], "coat_roughness": coat[1], "sheen_roughness": sheen_roughness}
    return {"type": PLUGIN, "base_color": rgb(base_color), "sheen": mi.ScalarColor3f(sheen), **values, **over}


def _lambda(cosine: Numbers, alpha: float, exp: Any, where: Any) -> Numbers:  # noqa: ANN401 - NumPy's or Dr.Jit's
    a, b, c, d, e = (_FIBRES[0] + (1 - alpha) ** 2 * (_FIBRES[1] - _FIBRES[0])).tolist()

    def power(x: Numbers) -> Numbers:
        return a / (1 + b * x**c) + d * x + e

    return where(cosine < 0.5, exp(power(cosine)), exp(2 * power(0.5) - power(1 - cosine)))


def _fibres(
    facing: Numbers, cosines: tuple[Numbers, Numbers], alpha: float, functions: tuple[Any, Any]
) -> Numbers:
    """Returns the BRDF of a white sheen; `facing`: the half-vector's cosine."""
    distribution = (2 + 1 / alpha) * (1 - facing * facing) ** (0.5 / alpha) / (2 * math.pi)
    shadow = 1 + sum(_lambda(each, alpha, *functions) for each in cosines)
    return distribution / (4 * shadow * cosines[0] * cosines[1])


@cache
def sheen_albedo(alpha: float) -> Float64[np.ndarray, " k"]:
    """Returns the directional albedo of a white sheen as LobeAlbedo has a lobe's."""
    x = (1 - np.cos(np.pi * (np.arange(ANGLES) + 0.5) / ANGLES)) / 2
    nodes, weights = np.polynomial.legendre.leggauss(2 * QUADRATURE)
    level, turn = np.meshgrid(((nodes + 1) / 2) ** 2, np.pi * (np.arange(400) + 0.5) / 400, indexing="ij")
    found = []
    for cosine in np.maximum(x * x, 1e-4):
        along = level * cosine + np.sqrt((1 - level**2) * (1 - cosine**2)) * np.cos(turn)
        facing = np.minimum((level + cosine) / np.sqrt(2 + 2 * along), 1)
        values = _fibres(facing, (level, cosine), alpha, (np.exp, np.where)) * level
        found.append(2 * np.pi * values.mean(axis=1) @ (weights / 2 * (nodes + 1)))
    return np.asarray(np.polynomial.chebyshev.chebfit(2 * x - 1, np.minimum(found, 1), DEGREE))


@dataclass(frozen=True, eq=False)
class CoatedSurface:
    """A base, and what lies over it: a coat (`amount`) of GGX roughness `alpha` over a sheen of `sheen_alpha`."""

    base: GlossySurface
    amount: float
    alpha: float
    energy: LobeEnergy
    facets: Numbers
    sheen: Float64[np.ndarray, "3"]
    sheen_alpha: float

    @classmethod
    def of(cls, props: Numbers) -> Self:
        """Returns the surface that Mitsuba's properties describe."""
        alpha = max(float(props["coat_roughness"]) ** 2, LEAST_ALPHA)
        return cls(
            GlossySurface.of(props),
            float(props["coat"]),
            alpha,
            LobeEnergy(lobe_albedo(alpha, (COAT_F0,) * 3, 0.0)),
            mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True),
            np.array(props["sheen"], np.float64).ravel(),
            max(float(props["sheen_roughness"]) ** 2, LEAST_SHEEN_ALPHA),
        )

    def sample(self, si: Numbers, sample1: Numbers, sample2: Numbers, active: Numbers) -> Numbers:
        """Draws a direction, of the coat or of the base."""
        normal, _ = self.facets.sample(si.wi, sample2)
        bs, _ = self.base.sample(
            si, (sample1 - self._coat_samples) / (1 - self._coat_samples), sample2, active
        )
        bs.wo = dr.select(sample1 < self._coat_samples, mi.reflect(si.wi, normal), bs.wo)
        value, bs.pdf = self.eval_pdf(si, bs.wo, active)
        found = bs.pdf > 0
        return bs, dr.select(found, value / dr.select(found, bs.pdf, 1), 0)

    @property
    def color(self) -> Numbers:
        """The texture that tells the base's colour."""
        return self.base.color

    def albedo(self, si: Numbers, active: Numbers) -> Numbers:
        """Returns that of the base."""
        return self.base.albedo(si, active)

    @property
    def _coat_samples(self) -> float:
        return COAT_SAMPLES if self.amount > 0 else 0.0

    def _coat_albedo(self, cosine: Numbers) -> Numbers:
        return self.amount * (1 - self.energy.below(cosine))

    def eval_pdf(self, si: Numbers, wo: Numbers, active: Numbers) -> Numbers:
        """Returns the BSDF times cosine, and the density of `sample` per solid angle."""
        value, pdf = self.base.eval_pdf(si, wo, active)
        cosine_i, cosine_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        seen = active & (cosine_i > 0) & (cosine_o > 0)
        cosine_i, cosine_o = dr.maximum(cosine_i, 1e-6), dr.maximum(cosine_o, 1e-6)
        normal = dr.normalize(si.wi + wo)
        facing = dr.maximum(dr.dot(si.wi, normal), 1e-6)
        matt = self.base.albedo(si, seen) * self.base.energy.base(cosine_i, cosine_o) / dr.pi * cosine_o
        mean = self.amount * float(self.energy.lobe.mean[0])
        dimmed = (1 - self._coat_albedo(cosine_o)) / (1 - mean)
        left = 1 - self._coat_albedo(cosine_i)
        fibres = dr.clip(polynomial(sheen_albedo(self.sheen_alpha), polynomial_place(cosine_i)), 0, 1)
        value = left * (1 - float(self.sheen.max()) * fibres) * (value - matt + matt * dimmed)
        value += left * self._sheen(normal, cosine_i, cosine_o) * cosine_o
        value += self.amount * cosine_o * self._coat(normal, facing, cosine_i, cosine_o)
        lobe = self.facets.pdf(si.wi, normal) / (4 * facing)
        pdf = self._coat_samples * lobe + (1 - self._coat_samples) * pdf
        return dr.select(seen, value, 0), dr.select(seen, pdf, 0)

    def _coat(self, normal: Numbers, facing: Numbers, cosine_i: Numbers, cosine_o: Numbers) -> Numbers:
        strength = self.facets.eval(normal) * smith_visibility(cosine_i, cosine_o, self.alpha)
        return strength * fresnel(facing, COAT_F0, 0.0) + self.energy.gaps(cosine_i, cosine_o)

    def _sheen(self, normal: Numbers, cosine_i: Numbers, cosine_o: Numbers) -> Numbers:
        facing = dr.clip(mi.Frame3f.cos_theta(normal), 0, 1 - 1e-6)
        white = _fibres(facing, (cosine_i, cosine_o), self.sheen_alpha, (dr.exp, dr.select))
        return mi.Color3f(*self.sheen.tolist()) * white
