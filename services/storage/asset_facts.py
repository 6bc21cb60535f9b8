"""Facts about a mesh, a map or a precomputed material, found by loading it (in the worker)."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.asset_kinds import Facts

if TYPE_CHECKING:
    from deltalight.render_server.scene.triangle_mesh import TriangleMesh


def mesh_facts(path: Path) -> Facts:
    """Loads a mesh and returns its facts.

    They are `triangles`, `vertices`, `minimum` and `maximum` (in the file's own units and axes, at rest), the
    `clips` (`name`, `duration_s`) that it can play, and the `material` of most of it, as scene documents write one.

    Raises:
        DeltalightError: the file is wrong; the sentence says how.
    """
    from deltalight.render_server.scene.asset_check import check_mesh_file, read_gltf

    if check_mesh_file(path) == ".glb":
        read_gltf(path)  # refuses a malformed file before the loader's second of imports
    import numpy as np

    from deltalight.render_server.scene.mesh_loading import load_asset

    asset = load_asset(path)
    meshes, clips = asset.meshes, () if asset.animated is None else asset.animated.clips
    if any("\0" in clip.name for clip in clips):
        raise DeltalightError(f"{path}: an animation's name must not hold a NUL character; leave it out.")
    bounds = np.stack([mesh.bounds() for mesh in meshes])
    return {
        "triangles": sum(len(mesh.triangles) for mesh in meshes),
        "vertices": sum(len(mesh.positions) for mesh in meshes),
        "minimum": bounds[:, 0].min(axis=0).tolist(),
        "maximum": bounds[:, 1].max(axis=0).tolist(),
        "clips": [{"name": clip.name, "duration_s": clip.duration_s} for clip in clips],
        "material": _material_facts(meshes),
    }


def _material_facts(meshes: Sequence["TriangleMesh"]) -> Facts:
    """Returns the material of the mesh with the most triangles; textures and vertex colours by their mean."""
    import numpy as np

    mesh = max(meshes, key=lambda each: len(each.triangles))
    material, color = mesh.material, np.asarray(mesh.material.base_color, np.float64)
    if material.base_color_texture is not None:
        color = color * material.base_color_texture.mean(axis=(0, 1), dtype=np.float64)
    rough_metal, emission = np.ones(2), np.asarray(material.emission, np.float64)
    if material.metallic_roughness_map is not None:
        rough_metal = material.metallic_roughness_map.texels[..., 1:].mean(axis=(0, 1)) / 255
    if material.emissive_map is not None:
        emission = emission * material.emissive_map.texels[..., :3].mean(axis=(0, 1), dtype=np.float64)
    if mesh.colors is not None:
        color = color * mesh.colors.mean(axis=0)
    return {
        "base_color": _rounded(np.clip(color, 0, 1)),
        "metallic": round(float(material.metallic * rough_metal[1]), 4),
        "roughness": round(float(material.roughness * rough_metal[0]), 4),
        "specular": round(float(material.specular * material.f0_tint.mean()), 4),
        "ior": None if material.ior is None else round(float(material.ior), 4),
        "emission": _rounded(emission),
        "transmission": round(float(material.transmission), 4),
        "thin_walled": material.is_thin,
        "attenuation_color": _rounded(material.attenuation_color),
        "attenuation_distance_m": _finite(material.attenuation_distance_m),
    }


def _finite(distance_m: float) -> float | None:
    return round(distance_m, 6) if math.isfinite(distance_m) else None


def _rounded(color: Iterable[float]) -> list[float]:
    return [round(float(value), 4) for value in color]


def map_facts(path: Path) -> Facts:
    """Loads an environment map and returns its `width` and `height` in pixels.

    Raises:
        DeltalightError: the file is wrong; the sentence says how.
    """
    from deltalight.protocol.radiance_files import read_linear

    height, width = read_linear(path).shape[:2]
    if width != 2 * height:
        raise DeltalightError(
            f"{path} has {width}x{height} pixels; a latitude-longitude map must be twice as wide as it is high."
        )
    return {"width": width, "height": height}


def material_facts(path: Path) -> Facts:
    """Loads a precomputed material; returns its `model`, mean `base_color` (linear) and what it is made of.

    A `measured_brdf` has `lobes` and the `roughness` of their mean, a `polynomial_texture` or `texture_stack` (ABTF)
    `width` and `height` in texels.

    Raises:
        DeltalightError: the file is wrong; the sentence says how.
    """
    from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf
    from deltalight.render_server.scene.material_file import read_material
    from deltalight.render_server.scene.texture_stack import TextureStack

    material = read_material(path)
    if isinstance(material, GaussianBrdf):
        return {
            "model": "measured_brdf",
            "base_color": _rounded(material.hemispherical_albedo),
            "lobes": len(material.sigmas),
            "roughness": round(material.roughness, 4),
        }
    height, width = material.albedo.shape[:2]
    mean = material.albedo.mean(axis=(0, 1), dtype="float64")
    model = "texture_stack" if isinstance(material, TextureStack) else "polynomial_texture"
    return {"model": model, "base_color": _rounded(mean), "width": width, "height": height}
