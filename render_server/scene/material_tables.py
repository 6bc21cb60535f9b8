"""Materials as the tables that shaders read: a row for each."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float32

from deltalight.render_server.scene.gaussian_brdf import TABLE_TEXELS
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.texture_maps import TextureMap
from deltalight.render_server.scene.texture_stack import TextureStack

MATERIAL_FLOATS, COATING_FLOATS = 20, 8


def material_table(materials: Sequence[Material]) -> Float32[np.ndarray, "k 20"]:
    """Packs materials for a shader, five vectors each.

    (base color, metallic), (dielectric F0, roughness), (emission, transmission), (1 double sided, -1 not seen from
    behind, row + 1 of `measured_table`, 0: not measured, a place that the GPU knows, layers of a stack, -1: unlit),
    (absorption 1/m, index of refraction; 0: thin).
    """
    measured = 0
    table = np.zeros((len(materials), MATERIAL_FLOATS), np.float32)
    for row, material in zip(table, materials, strict=True):
        row[0:4] = *material.base_color, material.metallic
        row[4:8] = *material.dielectric_f0, material.roughness
        row[8:12] = *material.emission, material.transmission
        row[12] = -1.0 if material.hides_back else material.double_sided
        if material.measured is not None:
            measured += 1
            row[13] = measured
        if isinstance(material.by_light, TextureStack):
            row[15] = len(material.by_light.layers)
        elif material.is_unlit:
            row[15] = -1
        row[16:20] = *material.absorption_per_m, 0.0 if material.is_thin else material.refraction_index
    return table


def coating_table(materials: Sequence[Material]) -> Float32[np.ndarray, "k 8"]:
    """Packs what lies over the bases, two vectors each: (coat, its roughness, the sheen's, 0), (sheen R G B, 0)."""
    table = np.zeros((len(materials), COATING_FLOATS), np.float32)
    for row, material in zip(table, materials, strict=True):
        row[:3] = material.coat, material.coat_roughness, material.sheen_roughness
        row[4:7] = material.sheen
    return table


def measured_table(materials: Sequence[Material]) -> Float32[np.ndarray, "k 93 4"]:
    """Returns the rows of the measured ones among the materials (common/measured.glsl)."""
    rows = [material.measured.table_row() for material in materials if material.measured is not None]
    return np.array(rows, np.float32).reshape(-1, TABLE_TEXELS, 4)


def map_table(
    materials: Sequence[Material],
    repeats_per_m: Float32[np.ndarray, " k"],
    layer_of: Callable[[TextureMap], int],
    count: int,
) -> Float32[np.ndarray, "k _"]:
    """Packs alpha and the first `count` maps for a shader, 1 + 3 `count` vectors each, behind all other rows.

    (alpha mode, alpha, repeats of the base colour's map a metre, `vertex_cutoff` or 0); for each map (row of u,
    layer or -1), (row of v, set of coordinates), (wraps, across + 3 down; columns and rows of an unfiltered texture,
    else 0; strength).
    """
    table = np.zeros((len(materials), 4 + 12 * count), np.float32)
    table[:, 7::12] = -1
    for row, material, repeats in zip(table, materials, repeats_per_m, strict=True):
        row[:4] = material.alpha_mode, material.alpha, repeats, material.vertex_cutoff or 0.0
        for place, each in enumerate(material.maps[:count]):
            if each is not None:
                row[4 + 12 * place :][:12] = _map_entry(each, layer_of(each))
    return table


def _map_entry(each: TextureMap, layer: int) -> tuple[float, ...]:
    height, width = each.texels.shape[:2] if each.is_nearest else (0, 0)
    wraps = float(each.wraps[0] + 3 * each.wraps[1])
    return (*each.from_uv[0], layer, *each.from_uv[1], each.uv_set, wraps, width, height, each.strength)
