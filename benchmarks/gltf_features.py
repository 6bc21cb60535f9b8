"""Features of glTF files, each beside the same look by plain means, in the manner of Khronos' sample models.

    python -m deltalight.benchmarks.gltf_features OUT

A column is a feature: above as the feature has it, below without it. Both have to look alike.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import typer
from jaxtyping import UInt8

from deltalight.benchmarks.gltf_plate import Plate, even
from deltalight.benchmarks.measured_materials import FOCAL, SIDE, codes_of, drawn_picture, lamps_of
from deltalight.protocol.files import write_png

LAMPS = (((-0.6, -0.3, -0.74), 2.0, 2.0),)
EDGE = 0.9 * SIDE / FOCAL  # m, of the plates
NEAREST = {"magFilter": 9728, "minFilter": 9728, "wrapS": 33071, "wrapT": 33071}  # clamped
MIRRORING = {**NEAREST, "wrapS": 33648, "wrapT": 33648}
QUARTERS = np.array([[[200, 40, 30], [40, 160, 60]], [[40, 70, 190], [230, 210, 70]]], np.uint8)
HALF_LINEAR = 188  # code of half of white's light


@dataclass(frozen=True)
class Feature:
    """What makes a plate's look by a feature, and by plain means; `sample` is Khronos' model that shows it."""

    sample: str
    feature: Callable[[Plate], None]
    plain: Callable[[Plate], None]


def _textured(plate: Plate, codes: UInt8[np.ndarray, "h w c"], sampler: dict[str, Any], **info: Any) -> None:  # noqa: ANN401 - a `textureInfo`
    plate.material["pbrMetallicRoughness"] = {
        "metallicFactor": 0,
        "baseColorTexture": plate.texture(codes, sampler, **info),
    }


def _transformed(plate: Plate) -> None:
    """Turned by a quarter about the lower left corner, as viewers turn."""
    turn = {"rotation": np.pi / 2, "offset": [0, 1]}
    _textured(plate, QUARTERS, NEAREST, extensions={"KHR_texture_transform": turn})


def _turned(plate: Plate) -> None:
    _textured(plate, np.rot90(QUARTERS, -1), NEAREST)


def _mirrored(plate: Plate) -> None:
    _textured(plate, QUARTERS, MIRRORING, extensions={"KHR_texture_transform": {"scale": [2, 2]}})


def _unfolded(plate: Plate) -> None:
    wide = np.concatenate([QUARTERS, QUARTERS[:, ::-1]], axis=1)
    _textured(plate, np.concatenate([wide, wide[::-1]]), NEAREST)


def _masked(plate: Plate) -> None:
    """By alpha of the vertices, from 0 at the left edge to 1 at the right."""
    plate.attributes["COLOR_0"] = plate.glb.floats([(1, 1, 1, alpha) for alpha in (0, 1, 1, 0)])
    plate.material |= {"alphaMode": "MASK", "pbrMetallicRoughness": {"metallicFactor": 0}}


def _cut(plate: Plate) -> None:
    x, y = plate.half_width, plate.half_height
    corners = [(0, -y, 0), (x, -y, 0), (x, y, 0), (0, y, 0)]
    plate.attributes["POSITION"] = plate.glb.floats(corners)
    plate.material["pbrMetallicRoughness"] = {"metallicFactor": 0}


def _bumps(turned: bool) -> UInt8[np.ndarray, "64 64 3"]:
    """Round bumps in a normal map; `turned`: by a quarter, as directions alone."""
    at = (np.indices((64, 64)) % 32 - 15.5) / 16
    tilt = np.stack([at[1], -at[0]], axis=-1) * (np.hypot(*at) < 0.9)[..., None]
    if turned:
        tilt = np.stack([tilt[..., 1], -tilt[..., 0]], axis=-1)
    normal = np.concatenate([0.6 * tilt, np.ones((64, 64, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.rint(255 * (0.5 + 0.5 * normal)), np.uint8)


def _bumpy(plate: Plate) -> None:
    plate.material |= {
        "pbrMetallicRoughness": {"metallicFactor": 0},
        "normalTexture": plate.texture(_bumps(False)),
    }


def _bumpy_by_tangents(plate: Plate) -> None:
    """The map's directions are turned, and its tangents turn them back."""
    plate.material |= {
        "pbrMetallicRoughness": {"metallicFactor": 0},
        "normalTexture": plate.texture(_bumps(True)),
    }
    plate.attributes["TANGENT"] = plate.glb.floats([(0, 1, 0, 1)] * 4)


def _glowing(factor: float, strength: float) -> Callable[[Plate], None]:
    def apply(plate: Plate) -> None:
        plate.material |= {
            "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
            "emissiveFactor": [factor, factor / 2, factor / 4],
        }
        plate.material["extensions"]["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}

    return apply


def _vertex_colored(plate: Plate) -> None:
    plate.attributes["COLOR_0"] = plate.glb.floats([(0.5, 0.5, 0.5)] * 4)
    plate.material["pbrMetallicRoughness"] = {"metallicFactor": 0}


def _grey(plate: Plate) -> None:
    _textured(plate, even(*(HALF_LINEAR,) * 3), NEAREST)


def _second_set(plate: Plate) -> None:
    plate.attributes["TEXCOORD_1"] = plate.attributes["TEXCOORD_0"]
    plate.attributes["TEXCOORD_0"] = plate.glb.floats([(0, 0)] * 4)
    _textured(plate, QUARTERS, NEAREST, texCoord=1)


def _first_set(plate: Plate) -> None:
    _textured(plate, QUARTERS, NEAREST)


def _unlit(plate: Plate) -> None:
    _textured(plate, QUARTERS, NEAREST)
    plate.material["extensions"]["KHR_materials_unlit"] = {}


def _self_lit(plate: Plate) -> None:
    plate.material |= {
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
        "emissiveTexture": plate.texture(QUARTERS, NEAREST),
        "emissiveFactor": [1, 1, 1],
    }


def _rough_metal(by_texture: bool) -> Callable[[Plate], None]:
    def apply(plate: Plate) -> None:
        pbr: dict[str, Any] = {"baseColorFactor": [0.9, 0.6, 0.3, 1]}
        if by_texture:
            pbr["metallicRoughnessTexture"] = plate.texture(even(0, 102, 204))
        else:
            pbr |= {"roughnessFactor": 102 / 255, "metallicFactor": 204 / 255}
        plate.material["pbrMetallicRoughness"] = pbr

    return apply


FEATURES = (
    Feature("TextureTransformTest", _transformed, _turned),
    Feature("TextureSettingsTest", _mirrored, _unfolded),
    Feature("AlphaBlendModeTest", _masked, _cut),
    Feature("NormalTangentTest", _bumpy_by_tangents, _bumpy),
    Feature("EmissiveStrengthTest", _glowing(0.25, 3.0), _glowing(0.75, 1.0)),
    Feature("VertexColorTest", _vertex_colored, _grey),
    Feature("MultiUVTest", _second_set, _first_set),
    Feature("UnlitTest", _unlit, _self_lit),
    Feature("MetalRoughSpheres", _rough_metal(True), _rough_metal(False)),
)


def written(path: Path, apply: Callable[[Plate], None], edge: float = EDGE) -> Path:
    """Writes a plate with a look, `edge` in metres; returns its path."""
    plate = Plate(edge, edge)
    apply(plate)
    return plate.write(path)


def main(out: Path) -> None:
    """Writes the picture; prints how far each feature is from the same look by plain means."""
    columns = []
    with TemporaryDirectory() as name:
        for feature in FEATURES:
            rows = []
            for row, apply in enumerate((feature.feature, feature.plain)):
                asset = written(Path(name) / f"{feature.sample}{row}.glb", apply)
                rows.append(codes_of(drawn_picture(asset, None, lamps_of(LAMPS))))
            apart = np.abs(rows[0].astype(int) - rows[1])
            typer.echo(f"{feature.sample}: mean {apart.mean():.3f}, greatest {apart.max()} of 255")
            columns.append(np.vstack([row[::2, ::2] for row in rows]))
    write_png(out, np.hstack(columns))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
