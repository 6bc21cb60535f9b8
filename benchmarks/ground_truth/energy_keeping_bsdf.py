"""Mitsuba's side of energy_keeping.py, whose numbers are Dr.Jit's: imported where Mitsuba is."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.ground_truth.energy_keeping import (
    LEAST_ALPHA,
    LobeAlbedo,
    Numbers,
    fresnel,
    lobe_albedo,
    smith_visibility,
)
from deltalight.benchmarks.ground_truth.parts import Triple


@dataclass(frozen=True, eq=False)
class LobeEnergy:
    """How a GGX lobe divides the light from a direction (its cosine): what it reflects at once, later, or never."""

    lobe: LobeAlbedo

    @cached_property
    def further(self) -> Numbers:
        """What more reflections let out of the light that gaps hold."""
        return mi.Color3f(*self.lobe.further.tolist())

    def single(self, cosine: Numbers) -> Numbers:
        """Returns what single reflection lets out."""
        x = polynomial_place(cosine)
        return dr.clip(mi.Color3f(*[polynomial(each, x) for each in self.lobe.single]), 0, 1)

    def held(self, cosine: Numbers) -> Numbers:
        """Returns what the gaps between facets still hold then."""
        return dr.clip(1 - polynomial(self.lobe.whole, polynomial_place(cosine)), 0, 1)

    def below(self, cosine: Numbers) -> Numbers:
        """Returns what the lobe leaves to the diffuse base."""
        return dr.maximum(1 - self.single(cosine) - self.held(cosine) * self.further, 0)

    def gaps(self, cosine_i: Numbers, cosine_o: Numbers) -> Numbers:
        """Returns the BSDF of further reflections (Kulla & Conty 2017)."""
        mean_held = max(1 - self.lobe.mean_whole, 1e-6)
        return self.held(cosine_i) * self.held(cosine_o) / (dr.pi * mean_held) * self.further

    def base(self, cosine_i: Numbers, cosine_o: Numbers) -> Numbers:
        """Returns what a base under the lobe reflects, relative to one without (Kelemen 2001)."""
        mean_left = np.maximum(1 - self.lobe.mean, 1e-6)
        return self.below(cosine_i) * self.below(cosine_o) / mi.Color3f(*mean_left.tolist())


@dataclass(frozen=True, eq=False)
class GlossySurface:
    """A GGX lobe of roughness `alpha` over a diffuse base of the colour `base` (a texture)."""

    base: Numbers
    metallic: float
    alpha: float
    f0: Triple
    energy: LobeEnergy
    facets: Numbers

    @classmethod
    def of(cls, props: Numbers) -> Self:
        """Returns the surface that Mitsuba's properties describe."""
        base, metallic = props.get_texture("base_color"), float(props["metallic"])
        alpha = max(float(props["roughness"]) ** 2, LEAST_ALPHA)
        f0 = _normal_reflectance(base, metallic, 0.08 * float(props["specular"]))
        facets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
        return cls(base, metallic, alpha, f0, LobeEnergy(lobe_albedo(alpha, f0, metallic)), facets)

    @property
    def color(self) -> Numbers:
        """The texture that tells its colour."""
        return self.base

    def albedo(self, si: Numbers, active: Numbers) -> Numbers:
        """Returns that of the base."""
        return (1 - self.metallic) * self.base.eval(si, active)

    def sample(self, si: Numbers, sample1: Numbers, sample2: Numbers, active: Numbers) -> Numbers:
        """Draws a direction, of the lobe or of the base."""
        is_glossy = sample1 < self._glossy_probability(si, active)
        normal, _ = self.facets.sample(si.wi, sample2)
        even = mi.warp.square_to_cosine_hemisphere(sample2)
        glossy, diffuse = (int(mi.BSDFFlags[f"{name}Reflection"]) for name in ("Glossy", "Diffuse"))
        bs: Numbers = mi.BSDFSample3f()
        bs.wo, bs.eta = dr.select(is_glossy, mi.reflect(si.wi, normal), even), 1.0
        bs.sampled_component = dr.select(is_glossy, mi.UInt32(0), mi.UInt32(1))
        bs.sampled_type = dr.select(is_glossy, mi.UInt32(glossy), mi.UInt32(diffuse))
        value, bs.pdf = self.eval_pdf(si, bs.wo, active)
        found = bs.pdf > 0
        return bs, dr.select(found, value / dr.select(found, bs.pdf, 1), 0)

    def eval_pdf(self, si: Numbers, wo: Numbers, active: Numbers) -> Numbers:
        """Returns the BSDF times cosine, and the density of `sample` per solid angle."""
        cosine_i, cosine_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        seen = active & (cosine_i > 0) & (cosine_o > 0)
        cosine_i, cosine_o = dr.maximum(cosine_i, 1e-6), dr.maximum(cosine_o, 1e-6)
        normal = dr.normalize(si.wi + wo)
        facing = dr.maximum(dr.dot(si.wi, normal), 1e-6)
        even = self.energy.gaps(cosine_i, cosine_o)
        even += self.albedo(si, seen) * self.energy.base(cosine_i, cosine_o) / dr.pi
        value = cosine_o * (self._glossy(normal, facing, cosine_i, cosine_o) + even)
        glossy = self._glossy_probability(si, seen)
        pdf = glossy * self.facets.pdf(si.wi, normal) / (4 * facing) + (1 - glossy) * cosine_o / dr.pi
        return dr.select(seen, value, 0), dr.select(seen, pdf, 0)

    def _glossy(self, normal: Numbers, facing: Numbers, cosine_i: Numbers, cosine_o: Numbers) -> Numbers:
        """Returns the BSDF of single reflection at facets that `normal` points from."""
        strength = self.facets.eval(normal) * smith_visibility(cosine_i, cosine_o, self.alpha)
        return strength * mi.Color3f(*[fresnel(facing, each, self.metallic) for each in self.f0])

    def _glossy_probability(self, si: Numbers, active: Numbers) -> Numbers:
        """Returns the probability of sampling the lobe: its fraction of what is reflected."""
        cosine = mi.Frame3f.cos_theta(si.wi)
        gaps = self.energy.held(cosine) * self.energy.further
        below = self.albedo(si, active) * self.energy.below(cosine)
        lobe, rest = dr.mean(self.energy.single(cosine)), dr.mean(gaps + below)
        return lobe / dr.maximum(lobe + rest, 1e-6)


class Surface(Protocol):
    """What a BSDF of `bsdf_class` asks of its surface; angles and directions are in its local frame."""

    @classmethod
    def of(cls, props: Numbers) -> Self:
        """Returns the surface that Mitsuba's properties describe."""

    def sample(self, si: Numbers, sample1: Numbers, sample2: Numbers, active: Numbers) -> Numbers:
        """Draws a direction."""

    def eval_pdf(self, si: Numbers, wo: Numbers, active: Numbers) -> Numbers:
        """Returns the BSDF times cosine, and the density of `sample` per solid angle."""

    def albedo(self, si: Numbers, active: Numbers) -> Numbers:
        """Returns the diffuse reflectance, which guides denoisers."""

    @property
    def color(self) -> Numbers:
        """The texture that tells its colour."""


def bsdf_class(kind: type[Surface]) -> type:
    """Returns the current variant's class of such surfaces; a context's choice of components is not heeded."""

    class SurfaceBsdf(mi.BSDF):
        """Hands everything on to its surface."""

        def __init__(self, props: Numbers) -> None:
            super().__init__(props)
            self.surface = kind.of(props)
            lobes = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection
            self.m_components = [lobe | mi.BSDFFlags.FrontSide for lobe in lobes]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def sample(
            self, _ctx: Numbers, si: Numbers, u: Numbers, uv: Numbers, active: Numbers = True
        ) -> Numbers:
            return self.surface.sample(si, u, uv, active)

        def eval(self, _ctx: Numbers, si: Numbers, wo: Numbers, active: Numbers = True) -> Numbers:
            return self.surface.eval_pdf(si, wo, active)[0]

        def pdf(self, _ctx: Numbers, si: Numbers, wo: Numbers, active: Numbers = True) -> Numbers:
            return self.surface.eval_pdf(si, wo, active)[1]

        def eval_pdf(self, _ctx: Numbers, si: Numbers, wo: Numbers, active: Numbers = True) -> Numbers:
            return self.surface.eval_pdf(si, wo, active)

        def eval_diffuse_reflectance(self, si: Numbers, active: Numbers = True) -> Numbers:
            return self.surface.albedo(si, active)

        def traverse(self, cb: Numbers) -> None:
            cb.put("base_color", self.surface.color, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return str(self.surface)

    return SurfaceBsdf


def _normal_reflectance(base: Numbers, metallic: float, dielectric: float) -> Triple:
    """Returns F0, R G B; a metal's is its colour, which must be one for the whole surface."""
    if metallic == 0:
        return (dielectric,) * 3
    color = np.array(base.eval(dr.zeros(mi.SurfaceInteraction3f))).ravel()
    red, green, blue = (1 - metallic) * dielectric + metallic * color
    return float(red), float(green), float(blue)


def polynomial_place(cosine: Numbers) -> Numbers:
    """Returns where LobeAlbedo's polynomials are evaluated."""
    return 2 * dr.sqrt(dr.clip(cosine, 0, 1)) - 1


def polynomial(coefficients: Float64[np.ndarray, " k"], x: Numbers) -> Numbers:
    """Returns a Chebyshev series by Clenshaw's recurrence."""
    last, before = 0.0 * x, 0.0 * x
    for value in coefficients[:0:-1]:
        last, before = float(value) + 2 * x * last - before, last
    return float(coefficients[0]) + x * last - before
