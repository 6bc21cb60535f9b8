"""Surface materials of virtual and modelled real objects, from scene documents and asset files."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from jaxtyping import Float16, Float32
from PIL import Image

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene_objects import Material as MaterialDocument

MAX_TEXTURE_PIXELS = 64_000_000
MATERIAL_FLOATS = 16


@dataclass(frozen=True, eq=False)
class Material:
    """Metallic/roughness surface of the Disney BRDF with GGX microfacets; reflectances are linear.

    `specular`: F0 = 0.08 specular, which `ior` overrides. `emission` is a radiance in camera units.
    `base_color_texture` is linear, row 0 at the top (uv (0, 0) is its top-left corner), and multiplies
    `base_color`. `roughness` is perceptual (alpha = roughness squared).
    """

    base_color: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.full(3, 0.8, np.float32))
    metallic: float = 0.0
    roughness: float = 0.5
    specular: float = 0.5
    ior: float | None = None
    emission: Float32[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3, np.float32))
    transmission: float = 0.0
    double_sided: bool = False
    base_color_texture: Float16[np.ndarray, "h w 3"] | None = None
    name: str = ""

    @property
    def dielectric_f0(self) -> float:
        """Reflectance at normal incidence of the dielectric part."""
        return 0.08 * self.specular if self.ior is None else ((self.ior - 1) / (self.ior + 1)) ** 2

    @property
    def f0(self) -> Float32[np.ndarray, "3"]:
        """Reflectance at normal incidence: dielectric and metal mixed by `metallic` (texture left out)."""
        mixed = (1 - self.metallic) * self.dielectric_f0 + self.metallic * self.base_color
        return mixed.astype(np.float32)

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
        )

    @classmethod
    def from_gltf(cls, description: dict[str, Any], base_color: Image.Image | None) -> Self:
        """Makes a material from an entry of a glTF document's `materials` and its decoded texture.

        Roughness and metallic textures are left out: their factors alone count.
        """
        pbr = description.get("pbrMetallicRoughness", {})
        extensions = description.get("extensions", {})
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        specular = extensions.get("KHR_materials_specular", {}).get("specularFactor", 1.0)
        transmission = extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0)
        return cls(
            base_color=np.array(pbr.get("baseColorFactor", [1, 1, 1, 1])[:3], np.float32),
            metallic=float(pbr.get("metallicFactor", 1.0)),
            roughness=float(pbr.get("roughnessFactor", 1.0)),
            specular=0.5 * float(specular),
            ior=extensions.get("KHR_materials_ior", {}).get("ior"),
            emission=np.array(description.get("emissiveFactor", [0, 0, 0]), np.float32) * float(strength),
            transmission=float(transmission),
            double_sided=bool(description.get("doubleSided", False)),
            base_color_texture=None if base_color is None else linear_texture(base_color),
            name=str(description.get("name", "")),
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
            base_color_texture=None if image is None else linear_texture(image),
            name=name,
        )

    def checked(self, place: str) -> Self:
        """Returns the material with colour, metallic and roughness clipped to 1.

        Raises:
            DeltalightError: a value is not finite or negative; `place` names the file.
        """
        numbers = np.array([*self.base_color, *self.emission, self.metallic, self.roughness, self.ior or 1.0])
        if numbers.shape != (9,) or not np.isfinite(numbers).all() or (numbers < 0).any():
            raise DeltalightError(
                f"{place}: the material `{self.name}` has a value below 0 or not finite; correct it."
            )
        return replace(
            self,
            base_color=np.minimum(self.base_color, 1.0),
            metallic=min(self.metallic, 1.0),
            roughness=min(self.roughness, 1.0),
        )


def _floats(value: Any, default: tuple[float, ...]) -> tuple[float, ...]:  # noqa: ANN401 - as in the file
    """Numbers of an MTL key; one number stands for three."""
    if value is None:
        return default
    numbers = tuple(float(item) for item in np.atleast_1d(value))
    return numbers * 3 if len(numbers) == 1 else numbers[:3]


def _first(value: Any, default: float) -> float:  # noqa: ANN401 - as in the file
    return default if value is None else float(np.atleast_1d(value)[0])


def linear_texture(image: Image.Image) -> Float16[np.ndarray, "h w 3"]:
    """Decodes an sRGB picture to linear R G B.

    Raises:
        DeltalightError: it has more than 64 million pixels or cannot be decoded.
    """
    if image.width * image.height > MAX_TEXTURE_PIXELS:
        raise DeltalightError(f"a texture of {image.width}x{image.height} pixels is too large; reduce it.")
    try:
        codes = np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise DeltalightError(f"a texture cannot be decoded ({error}); export the mesh again.") from error
    return np.asarray(decode_lut(None)[:, 0].astype(np.float16)[codes])


def material_table(materials: Sequence[Material]) -> Float32[np.ndarray, "k 16"]:
    """Packs materials for a shader, four vectors each.

    (base color, metallic), (dielectric F0 three times, roughness), (emission, transmission),
    (double sided 0/1, index of the texture among those that have one or -1, 0, 0).
    """
    table = np.zeros((len(materials), MATERIAL_FLOATS), np.float32)
    textures = 0
    for row, material in zip(table, materials, strict=True):
        has_texture = material.base_color_texture is not None
        row[0:4] = *material.base_color, material.metallic
        row[4:8] = *([material.dielectric_f0] * 3), material.roughness
        row[8:12] = *material.emission, material.transmission
        row[12:14] = material.double_sided, textures if has_texture else -1
        textures += has_texture
    return table
