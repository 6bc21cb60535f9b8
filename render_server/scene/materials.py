"""Surface materials of virtual and modelled real objects, from scenes and asset files."""

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Self

import numpy as np
from jaxtyping import Float16, Float32
from PIL import Image

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import Material as MaterialDocument
from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf
from deltalight.render_server.scene.texture_maps import TextureMap, TextureReader, linear_texture
from deltalight.render_server.scene.textures_by_light import TextureByLight

DARKEST_ATTENUATION = 1e-4  # black has no logarithm
COAT_F0 = 0.04  # reflectance of a clear coat at normal incidence, of index 1.5
MASK_SLOPE = 8.0  # of the coverage that an alpha mask becomes, over alpha


class AlphaMode(IntEnum):
    """What alpha means (glTF 2.0, section 3.9.4)."""

    OPAQUE = 0
    MASK = 1
    BLEND = 2


@dataclass(frozen=True, eq=False)
class Material:
    """Metallic/roughness surface of the Disney BRDF with GGX microfacets; reflectances are linear.

    `specular`: F0 = 0.08 specular, which `ior` overrides; `f0_tint` multiplies either. `emission` is a radiance in
    camera units. `roughness` is perceptual (alpha = roughness squared). Maps multiply the values that they are named
    after: roughness by green, metallic by blue. `alpha` multiplies that of the base colour's map. `vertex_cutoff` is
    that of a mask whose alpha vertices multiply too, else None. Vertex colours multiply the base colour, and the
    emission of what `is_unlit`.

    `transmission` is the fraction of the light entering the surface that goes on through it, the rest is diffuse. The
    solid behind a surface that is not thin turns white light into `attenuation_color` over `attenuation_distance_m`.

    `coat` is the fraction of the surface under a clear lacquer of index 1.5 (KHR_materials_clearcoat), `sheen` the
    colour of fibres between it and the base (KHR_materials_sheen); both have their own roughness.

    `double_sided` surfaces shade both sides. Those that `hides_back` are not seen from behind, and still cast
    shadows.

    `measured` replaces the rest where the camera sees the surface; elsewhere a Lambertian of its albedo does.
    `by_light` replaces the light of lamps there alone, and that of a map in image-based shading.
    """

    base_color: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.full(3, 0.8, np.float32))
    metallic: float = 0.0
    roughness: float = 0.5
    specular: float = 0.5
    ior: float | None = None
    f0_tint: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.ones(3, np.float32))
    emission: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3, np.float32))
    transmission: float = 0.0
    is_thin: bool = False
    attenuation_color: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.ones(3, np.float32))
    attenuation_distance_m: float = math.inf
    coat: float = 0.0
    coat_roughness: float = 0.0
    sheen: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3, np.float32))
    sheen_roughness: float = 0.0
    is_unlit: bool = False
    double_sided: bool = False
    hides_back: bool = False
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    alpha: float = 1.0
    vertex_cutoff: float | None = None
    base_color_map: TextureMap | None = None
    metallic_roughness_map: TextureMap | None = None
    normal_map: TextureMap | None = None
    occlusion_map: TextureMap | None = None
    emissive_map: TextureMap | None = None
    coat_map: TextureMap | None = None
    coat_roughness_map: TextureMap | None = None
    coat_normal_map: TextureMap | None = None
    sheen_map: TextureMap | None = None
    sheen_roughness_map: TextureMap | None = None
    specular_map: TextureMap | None = None
    specular_color_map: TextureMap | None = None
    transmission_map: TextureMap | None = None
    measured: GaussianBrdf | None = None
    by_light: TextureByLight | None = None
    name: str = ""

    @property
    def maps(self) -> tuple[TextureMap | None, ...]:
        """Its maps, in the order of the shaders' table; those of extensions come last."""
        return (
            self.base_color_map,
            self.metallic_roughness_map,
            self.normal_map,
            self.occlusion_map,
            self.emissive_map,
            self.coat_map,
            self.coat_roughness_map,
            self.coat_normal_map,
            self.sheen_map,
            self.sheen_roughness_map,
            self.specular_map,
            self.specular_color_map,
            self.transmission_map,
        )

    @property
    def is_coated(self) -> bool:
        """Whether a coat or a sheen lies over its base."""
        return self.coat > 0 or bool(np.any(self.sheen > 0))

    @property
    def is_extended(self) -> bool:
        """Whether it is coated, or has maps of what its dielectric part reflects and lets through."""
        of_dielectric = self.specular_map, self.specular_color_map, self.transmission_map
        return self.is_coated or any(each is not None for each in of_dielectric)

    @property
    def has_second_uv(self) -> bool:
        """Whether any of its maps lies on the second set of texture coordinates."""
        return any(each is not None and each.uv_set == 1 for each in self.maps)

    @property
    def has_normal_maps(self) -> bool:
        """Whether a map bends its normals, or those of its coat."""
        return self.normal_map is not None or self.coat_normal_map is not None

    @property
    def base_color_texture(self) -> Float16[np.ndarray, "h w 3"] | None:
        """The linear colours of the base colour's map."""
        return None if self.base_color_map is None else self.base_color_map.texels[..., :3]

    @property
    def dielectric_f0(self) -> Float32[np.ndarray, "3"]:
        """Reflectance at normal incidence of the dielectric part."""
        plain = 0.08 * self.specular if self.ior is None else ((self.ior - 1) / (self.ior + 1)) ** 2
        return np.minimum(plain * self.f0_tint, 1.0).astype(np.float32)

    @property
    def f0(self) -> Float32[np.ndarray, "3"]:
        """Reflectance at normal incidence: dielectric and metal mixed by `metallic` (texture left out)."""
        mixed = (1 - self.metallic) * self.dielectric_f0 + self.metallic * self.base_color
        return mixed.astype(np.float32)

    @property
    def diffuse_reflectance(self) -> Float32[np.ndarray, "3"]:
        """What is reflected diffusely, its maps left out; the thin lobe above it counts to it."""
        return np.asarray((1 - self.metallic) * (1 - self.transmission) * self.base_color, np.float32)

    @property
    def transmits(self) -> bool:
        """Whether light passes through it."""
        return self.transmission > 0 and self.metallic < 1

    @property
    def refraction_index(self) -> float:
        """Index of refraction of the solid; if none is given, that of a surface that is as specular (0.5: 1.5)."""
        if self.ior is not None:
            return max(self.ior, 1.0)
        amplitude = math.sqrt(0.08 * self.specular)
        return (1 + amplitude) / (1 - amplitude)

    @property
    def absorption_per_m(self) -> Float32[np.ndarray, "3"]:
        """Absorption coefficient of the solid, 1/m: -ln(attenuation colour) / distance (KHR_materials_volume)."""
        if self.is_thin:
            return np.zeros(3, np.float32)
        darkest = np.maximum(self.attenuation_color, DARKEST_ATTENUATION)
        return np.asarray(-np.log(darkest) / np.float32(self.attenuation_distance_m), np.float32)

    def mean_transmittance(self, path_m: float) -> Float32[np.ndarray, "3"]:
        """Returns what passes of light at normal incidence: two surfaces and a path between, or a thin one; R G B.

        A coat reflects a part before light enters; rays do not meet it as they leave, either.
        """
        through = self.transmission * (1 - self.metallic) * _mean_red(self.transmission_map)
        entered = (1 - self.dielectric_f0) * self.base_color * np.float32(through)
        below = 1 - COAT_F0 * self.coat * _mean_red(self.coat_map)
        return np.asarray(
            below
            * entered ** (1 if self.is_thin else 2)
            * np.exp(-self.absorption_per_m * np.float32(path_m)),
            np.float32,
        )

    @classmethod
    def from_document(cls, document: MaterialDocument) -> Self:
        """Makes a material from a scene document, which replaces the asset's own."""
        return cls(
            base_color=np.array(document.base_color, np.float32),
            metallic=document.metallic,
            roughness=document.roughness,
            specular=document.specular,
            ior=document.ior,
            emission=np.array(document.emission, np.float32),
            transmission=document.transmission,
            is_thin=document.thin_walled,
            attenuation_color=np.array(document.attenuation_color, np.float32),
            attenuation_distance_m=document.attenuation_distance_m or math.inf,
        )

    @classmethod
    def from_measured(cls, brdf: GaussianBrdf) -> Self:
        """Makes a material from a sum of Gaussians; its roughness is that of a lobe as wide as the mean of them."""
        return cls(
            base_color=brdf.hemispherical_albedo.astype(np.float32),
            specular=0.0,
            roughness=brdf.roughness,
            measured=brdf,
        )

    @classmethod
    def from_texture_by_light(cls, texture: TextureByLight) -> Self:
        """Makes a material from a texture by the light's direction: its albedo for all light but that of lamps."""
        return cls(
            base_color=np.ones(3, np.float32),
            specular=texture.f0 / 0.08,
            roughness=texture.roughness,
            base_color_map=TextureMap(texture.albedo),
            by_light=texture,
        )

    @cached_property
    def maps_by_light(self) -> tuple[TextureMap, ...]:
        """The planes of `by_light` as textures that follow each other."""
        return () if self.by_light is None else tuple(map(TextureMap, self.by_light.planes))

    @classmethod
    def from_gltf(
        cls, description: dict[str, Any], textures: TextureReader, *, vertices_have_alpha: bool = False
    ) -> Self:
        """Makes a material from an entry of a glTF document's `materials`, for vertices with alpha or without.

        Raises:
            GltfFaultError: a texture cannot be used.
        """
        pbr, extensions = description.get("pbrMetallicRoughness", {}), description.get("extensions", {})
        color = np.array(pbr.get("baseColorFactor", [1, 1, 1, 1]), np.float32)
        material = cls._with_gltf_factors(description, color[:3])._with_gltf_maps(description, textures)
        mode = AlphaMode[description.get("alphaMode", "OPAQUE")]
        base_map = textures.color(pbr.get("baseColorTexture"), with_alpha=mode != AlphaMode.OPAQUE)
        material = replace(material, base_color_map=base_map)
        cutoff = float(description.get("alphaCutoff", 0.5))
        if mode == AlphaMode.MASK and vertices_have_alpha:
            material = material._masked_by_vertices(float(color[3]), cutoff)
        else:
            material = material._with_alpha(mode, float(color[3]), cutoff)
        if "KHR_materials_unlit" in extensions:
            return material._unlit()
        return material if material.is_coated else material._without_coating()

    @classmethod
    def _with_gltf_factors(cls, description: dict[str, Any], base_color: Float32[np.ndarray, "3"]) -> Self:
        """Makes a material without textures; alpha follows."""
        pbr, extensions = description.get("pbrMetallicRoughness", {}), description.get("extensions", {})
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        transmission = extensions.get("KHR_materials_transmission", {})
        volume = extensions.get("KHR_materials_volume", {})
        coat = extensions.get("KHR_materials_clearcoat", {})
        sheen = extensions.get("KHR_materials_sheen", {})
        is_double_sided = bool(description.get("doubleSided", False))
        return cls(
            base_color=base_color,
            metallic=float(pbr.get("metallicFactor", 1.0)),
            roughness=float(pbr.get("roughnessFactor", 1.0)),
            ior=extensions.get("KHR_materials_ior", {}).get("ior"),
            f0_tint=_f0_tint(extensions.get("KHR_materials_specular", {})),
            emission=np.array(description.get("emissiveFactor", [0, 0, 0]), np.float32) * float(strength),
            transmission=float(transmission.get("transmissionFactor", 0.0)),
            is_thin=not volume.get("thicknessFactor", 0.0),
            attenuation_color=np.array(volume.get("attenuationColor", [1, 1, 1]), np.float32),
            attenuation_distance_m=float(volume.get("attenuationDistance", math.inf)),
            coat=float(coat.get("clearcoatFactor", 0.0)),
            coat_roughness=float(coat.get("clearcoatRoughnessFactor", 0.0)),
            sheen=np.array(sheen.get("sheenColorFactor", [0, 0, 0]), np.float32),
            sheen_roughness=float(sheen.get("sheenRoughnessFactor", 0.0)),
            double_sided=is_double_sided,
            hides_back=not is_double_sided,
            name=str(description.get("name", "")),
        )

    def _with_gltf_maps(self, description: dict[str, Any], textures: TextureReader) -> Self:
        """Returns the material with its textures, but for that of the base colour."""
        pbr, extensions = description.get("pbrMetallicRoughness", {}), description.get("extensions", {})
        specular = extensions.get("KHR_materials_specular", {})
        transmission = extensions.get("KHR_materials_transmission", {})
        coat = extensions.get("KHR_materials_clearcoat", {})
        sheen = extensions.get("KHR_materials_sheen", {})
        return replace(
            self,
            metallic_roughness_map=textures.data(pbr.get("metallicRoughnessTexture")),
            normal_map=textures.data(description.get("normalTexture"), "scale"),
            occlusion_map=textures.data(description.get("occlusionTexture"), "strength"),
            emissive_map=textures.color(description.get("emissiveTexture")),
            coat_map=textures.data(coat.get("clearcoatTexture")),
            coat_roughness_map=textures.data(coat.get("clearcoatRoughnessTexture")),
            coat_normal_map=textures.data(coat.get("clearcoatNormalTexture"), "scale"),
            sheen_map=textures.color(sheen.get("sheenColorTexture"), with_alpha=True),
            sheen_roughness_map=textures.color(sheen.get("sheenRoughnessTexture"), with_alpha=True),
            specular_map=textures.color(specular.get("specularTexture"), with_alpha=True),
            specular_color_map=textures.color(specular.get("specularColorTexture"), with_alpha=True),
            transmission_map=textures.data(transmission.get("transmissionTexture")),
        )

    def _masked_by_vertices(self, factor: float, cutoff: float) -> Self:
        """Returns the material with a mask that vertices' alpha multiplies, so that shaders compare; all passes 0."""
        if cutoff <= 0:
            return self
        return replace(self, alpha_mode=AlphaMode.MASK, alpha=min(factor, 1.0), vertex_cutoff=cutoff)

    def _with_alpha(self, mode: AlphaMode, factor: float, cutoff: float) -> Self:
        """Returns the material with its alpha; a mask becomes coverage, one half at the cutoff.

        So the map's mip levels hold the fraction of the surface that is there.
        """
        if mode != AlphaMode.MASK or self.base_color_map is None:
            is_there = mode != AlphaMode.MASK or factor >= cutoff
            return replace(self, alpha_mode=mode, alpha=min(factor, 1.0) * is_there if mode else 1.0)
        texels = self.base_color_map.texels.copy()
        texels[..., 3] = np.clip(0.5 + (texels[..., 3] * factor - cutoff) * MASK_SLOPE, 0, 1)
        return replace(self, alpha_mode=mode, base_color_map=replace(self.base_color_map, texels=texels))

    def _without_coating(self) -> Self:
        """Returns the material without the maps of a coat and a sheen, which it lacks."""
        return replace(
            self,
            coat_map=None,
            coat_roughness_map=None,
            coat_normal_map=None,
            sheen_map=None,
            sheen_roughness_map=None,
        )

    def _unlit(self) -> Self:
        """Returns the material that glows with its base colour instead of being lit (KHR_materials_unlit)."""
        return replace(
            self._without_coating(),
            specular_map=None,
            specular_color_map=None,
            transmission_map=None,
            base_color=np.zeros(3, np.float32),
            coat=0.0,
            sheen=np.zeros(3, np.float32),
            metallic=0.0,
            roughness=1.0,
            f0_tint=np.zeros(3, np.float32),
            emission=self.base_color,
            is_unlit=True,
            emissive_map=self.base_color_map,
            metallic_roughness_map=None,
            normal_map=None,
            occlusion_map=None,
        )

    @classmethod
    def from_mtl(cls, name: str, keys: dict[str, Any], image: Image.Image | None) -> Self:
        """Makes a material from the lower-case keys of an OBJ material library.

        Kd and Ke are linear. The Phong exponent Ns becomes alpha = sqrt(2/(Ns + 2)) (Walter et al. 2007); Ks
        only tells whether the surface is specular at all, for it is no reflectance at normal incidence.
        """
        exponent = float(np.clip(_first(keys.get("ns"), 30.0), 0.0, 1e6))
        shiny = bool(np.any(np.asarray(_floats(keys.get("ks"), (1.0,)), float) > 0))
        return cls(
            base_color=np.array(_floats(keys.get("kd"), (0.8, 0.8, 0.8)), np.float32),
            roughness=float(np.sqrt(np.sqrt(2 / (exponent + 2)))),
            specular=0.5 if shiny else 0.0,
            emission=np.array(_floats(keys.get("ke"), (0.0, 0.0, 0.0)), np.float32),
            base_color_map=None if image is None else TextureMap(linear_texture(image)),
            name=name,
        )

    def checked(self, place: str) -> Self:
        """Returns the material with colour, metallic and roughness clipped to 1.

        Raises:
            DeltalightError: a value is not finite or negative, or light is absorbed over no distance; `place` names
                the file.
        """
        ior = 1.0 if self.ior is None else self.ior
        scalars = self.metallic, self.roughness, ior, self.alpha, self.transmission
        over = self.coat, self.coat_roughness, *self.sheen, self.sheen_roughness
        colors = *self.base_color, *self.emission, *self.f0_tint, *self.attenuation_color
        numbers = np.array([*colors, *scalars, *over])
        if not self.attenuation_distance_m > 0:
            raise DeltalightError(
                f"{place}: the material `{self.name}` has an attenuationDistance that is not above 0; correct it."
            )
        if numbers.shape != (23,) or not np.isfinite(numbers).all() or (numbers < 0).any():
            raise DeltalightError(
                f"{place}: the material `{self.name}` has a value below 0 or not finite; correct it."
            )
        return replace(
            self,
            base_color=np.minimum(self.base_color, 1.0),
            metallic=min(self.metallic, 1.0),
            roughness=min(self.roughness, 1.0),
            transmission=min(self.transmission, 1.0),
            coat=min(self.coat, 1.0),
            coat_roughness=min(self.coat_roughness, 1.0),
            sheen=np.minimum(self.sheen, 1.0),
            sheen_roughness=min(self.sheen_roughness, 1.0),
            attenuation_color=np.minimum(self.attenuation_color, 1.0),
        )


def _f0_tint(specular: dict[str, Any]) -> Float32[np.ndarray, "3"]:
    """Returns what KHR_materials_specular makes of the reflectance at normal incidence."""
    color = np.array(specular.get("specularColorFactor", [1, 1, 1]), np.float32)
    return np.asarray(color * np.float32(specular.get("specularFactor", 1.0)))


def _floats(value: Any, default: tuple[float, ...]) -> tuple[float, ...]:  # noqa: ANN401 - as in the file
    """Numbers of an MTL key; one number stands for three."""
    if value is None:
        return default
    numbers = tuple(float(item) for item in np.atleast_1d(value))
    return numbers * 3 if len(numbers) == 1 else numbers[:3]


def _mean_red(each: TextureMap | None) -> float:
    """Returns the mean of a data map's first channel, 1 without a map."""
    return 1.0 if each is None else float(each.texels[..., 0].mean()) / 255


def _first(value: Any, default: float) -> float:  # noqa: ANN401 - as in the file
    return default if value is None else float(np.atleast_1d(value)[0])
