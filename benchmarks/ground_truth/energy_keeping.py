"""The truth's glossy material: a BSDF for Mitsuba that keeps the light, as none of its own does at every roughness.

It has the renderer's physics and none of its numbers: integrals are by quadrature here, a dielectric's Fresnel term
is the exact one, and what microfacets throw at each other leaves in the lobe of Kulla and Conty (2017), not in
Turquin's.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.ground_truth.parts import Triple

Numbers: TypeAlias = Any
"""A float, an array of NumPy or of Dr.Jit, or a record of Mitsuba that holds some."""
PLUGIN = "energy_keeping"
LEAST_ALPHA = 1e-3
QUADRATURE = 128
"""Visible microfacets away from the normal, and around it."""
DEGREE, ANGLES = 24, 64
"""Of the polynomials in the root of the cosine, and the angles that they are fitted to."""
_registered: set[str] = set()  # variants


def energy_keeping(
    base_color: dict[str, Any], *, roughness: float, metallic: float = 0.0, specular: float = 0.5
) -> dict[str, Any]:
    """Returns a GGX lobe over a diffuse base, in the scene document's terms (docs/formats.md 3).

    `base_color` is Mitsuba's: one colour, or a texture if `metallic` is 0. It is a material of one side.
    """
    values = {"roughness": roughness, "metallic": metallic, "specular": specular}
    return {"type": PLUGIN, "base_color": base_color, **values}


def fresnel(cosine: Numbers, f0: float, metallic: float) -> Numbers:
    """Returns what a microfacet reflects: the exact term of a dielectric, Schlick's of a metal."""
    root = f0**0.5
    eta = (1 + root) / (1 - root) if metallic < 1 else 1.0
    schlick = f0 + (1 - f0) * (1 - cosine) ** 5
    if metallic == 1:
        return schlick
    g = (eta * eta - 1 + cosine * cosine) ** 0.5
    parallel = (cosine * (g + cosine) - 1) / (cosine * (g - cosine) + 1)
    exact = 0.5 * ((g - cosine) / (g + cosine)) ** 2 * (1 + parallel * parallel)
    return metallic * schlick + (1 - metallic) * exact


def smith_visibility(cosine_i: Numbers, cosine_o: Numbers, alpha: float) -> Numbers:
    """Returns G / (4 cos cos) of the height-correlated Smith term (Heitz 2014)."""
    a2 = alpha * alpha
    sum_i = cosine_o * (cosine_i * cosine_i * (1 - a2) + a2) ** 0.5
    sum_o = cosine_i * (cosine_o * cosine_o * (1 - a2) + a2) ** 0.5
    return 0.5 / (sum_i + sum_o)


@dataclass(frozen=True, eq=False)
class LobeAlbedo:
    """Fraction of the light from one direction that a GGX lobe reflects: Chebyshev polynomials in 2 sqrt(cosine) - 1.

    `single` (R G B) is that of one reflection, `whole` as if microfacets reflected all. `further` (R G B) is the part
    of what one reflection leaves between them, `1 - whole`, that more reflections let out. `mean` (R G B) is the
    fraction of light from everywhere that all reflections let out, `mean_whole` that of `whole`.
    """

    single: Float64[np.ndarray, "3 k"]
    whole: Float64[np.ndarray, " k"]
    further: Float64[np.ndarray, " 3"]
    mean: Float64[np.ndarray, " 3"]
    mean_whole: float


@cache
def lobe_albedo(alpha: float, f0: Triple, metallic: float) -> LobeAlbedo:
    """Integrates the lobe for a GGX roughness `alpha`."""
    x = (1 - np.cos(np.pi * (np.arange(ANGLES) + 0.5) / ANGLES)) / 2
    rows = np.array([_integrals(float(root * root), alpha, f0, metallic) for root in x])
    fits = np.polynomial.chebyshev.chebfit(2 * x - 1, rows, DEGREE)
    nodes, weights = np.polynomial.legendre.leggauss(2 * ANGLES)
    cosine, weights = (nodes + 1) / 2, weights / 2
    mean = 2 * np.polynomial.chebyshev.chebval(2 * np.sqrt(cosine) - 1, fits) @ (weights * cosine)
    facet = np.array([2 * (weights * cosine) @ fresnel(cosine, each, metallic) for each in f0])
    # A bounce in the gaps lets `mean[3]` out and keeps the rest for the next: a geometric series of bounces 2, 3, ...
    further = facet**2 * mean[3] / (1 - facet * (1 - mean[3]))
    return LobeAlbedo(fits[:, :3].T, fits[:, 3], further, mean[:3] + (1 - mean[3]) * further, float(mean[3]))


def _integrals(cosine: float, alpha: float, f0: Triple, metallic: float) -> Float64[np.ndarray, " 4"]:
    """Returns the light that one reflection lets out, R G B and with F = 1: means over visible normals.

    Those are on the unit sphere's part that the stretched view sees (Dupuy & Benyoub 2023).
    """
    # Gauss's nodes lie close at the ends: where facets lean so far that light goes down again is a small end of u.
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    u, v = np.meshgrid((nodes + 1) / 2, (np.arange(QUADRATURE) + 0.5) / QUADRATURE)
    wi = np.array([np.sqrt(1 - cosine * cosine), 0.0, cosine])
    stretched = wi * [alpha, alpha, 1]
    stretched /= np.linalg.norm(stretched)
    z = (1 - u) * (1 + stretched[2]) - stretched[2]
    around = np.sqrt(np.maximum(1 - z * z, 0))
    cap = np.stack([around * np.cos(2 * np.pi * v), around * np.sin(2 * np.pi * v), z], axis=-1) + stretched
    m = cap * [alpha, alpha, 1]
    m /= np.linalg.norm(m, axis=-1, keepdims=True)
    facing = m @ wi
    out = 2 * facing * m[..., 2] - cosine
    seen = np.where(out > 0, _masking(np.maximum(out, 1e-9), cosine, alpha), 0.0)
    parts = np.stack([*(fresnel(facing, each, metallic) * seen for each in f0), seen])
    return np.asarray(parts.mean(axis=1) @ (weights / 2))


def _masking(out: Float64[np.ndarray, "n n"], cosine: float, alpha: float) -> Float64[np.ndarray, "n n"]:
    """Returns G / G1 towards the light's side."""
    g1 = 2 * cosine / (cosine + np.sqrt(cosine**2 * (1 - alpha**2) + alpha**2))
    return np.asarray(smith_visibility(cosine, out, alpha) * 4 * cosine * out / g1)


def register() -> None:
    """Makes the material known to Mitsuba's current variant."""
    import mitsuba as mi

    from deltalight.benchmarks.ground_truth.energy_keeping_bsdf import GlossySurface, bsdf_class

    variant = str(mi.variant())
    if variant not in _registered:
        mi.register_bsdf(PLUGIN, bsdf_class(GlossySurface))
        _registered.add(variant)
