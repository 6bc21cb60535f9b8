"""The shelf's helmet: a painted shell with a metal visor, all of whose detail is in its textures.

Everything is a function of the direction from the helmet's middle, given by its azimuth (0 = front, to the wearer's
left) and elevation. Textures are such directions by column and row, so that the seam is at the back.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.frames import srgb_code
from deltalight.services.storage.shelf_glb import glb

if TYPE_CHECKING:
    import trimesh

RADII_M = (0.066, 0.078, 0.078)  # to the sides, front and back, up
CUT_DEG = -62.0  # below, the shell narrows to the neck
NECK_RADIUS_M, NECK_DROP_M = 0.048, 0.012
COLUMNS, ROWS = 96, 60  # of the mesh
TEXTURE = (384, 768)  # rows, columns
VISOR_DEG, VISOR_AT_DEG = (64.0, 25.0), -2.0  # half its width and height; elevation of its middle
VISOR_POWER = 3.0  # of the superellipse
EAR_DEG = 19.0
INSET_M, RIDGE_M, EAR_M = 0.004, 0.005, 0.006
RIM_WIDTH = 0.1  # of the visor's rim, as a fraction of its size
PANEL_LINES_DEG = (-35.0, 45.0)  # elevations
LINE_DEG, LINE_DEPTH_M, RIVET_HEIGHT_M = 0.8, 0.0006, 0.0008
SEED = 7
STRIPE_DEG = 9.0  # half the width of the stripe across the top

PAINT, STRIPE, RUBBER = (0.62, 0.64, 0.66), (0.75, 0.16, 0.02), (0.03, 0.03, 0.035)
STEEL, GOLD = (0.56, 0.57, 0.58), (1.0, 0.71, 0.29)
LAMP = (0.1, 0.8, 1.0)
LAMP_RADIANCE = 3.0  # in camera units
NAME = "Helmet"

Map = Float64[np.ndarray, "h w"]
Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class Directions:
    """A grid of directions, degrees."""

    azimuth: Map
    elevation: Map

    @staticmethod
    def grid(rows: Float64[np.ndarray, " h"], columns: Float64[np.ndarray, " w"]) -> "Directions":
        """Returns directions of elevations by rows and azimuths by columns."""
        azimuth, elevation = np.meshgrid(columns, rows)
        return Directions(azimuth, elevation)

    @cached_property
    def unit(self) -> Float64[np.ndarray, "h w 3"]:
        """Unit vectors: x to the wearer's left, y to the back, z up."""
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        level = np.cos(elevation)
        return np.stack([level * np.sin(azimuth), -level * np.cos(azimuth), np.sin(elevation)], axis=-1)

    @cached_property
    def visor(self) -> Map:
        """0 in the visor's middle, 1 on its edge."""
        across = np.abs(self.azimuth) / VISOR_DEG[0]
        up = np.abs(self.elevation - VISOR_AT_DEG) / VISOR_DEG[1]
        return np.asarray((across**VISOR_POWER + up**VISOR_POWER) ** (1 / VISOR_POWER))

    @cached_property
    def ear(self) -> Map:
        """Degrees from the nearer ear's middle."""
        return np.asarray(np.degrees(np.arccos(np.clip(np.abs(self.unit[..., 0]), 0, 1))))

    @cached_property
    def across(self) -> Map:
        """Degrees from the plane that halves the helmet."""
        return np.asarray(np.degrees(np.arcsin(np.clip(np.abs(self.unit[..., 0]), 0, 1))))

    @cached_property
    def stripe(self) -> Map:
        """1 on the stripe over the top, 0 elsewhere."""
        is_above = (self.visor > 1 + RIM_WIDTH) & ((self.elevation > 0) | (np.abs(self.azimuth) > 90))
        return np.asarray(is_above * _step(STRIPE_DEG - self.across, 0.5))

    def noise(self, scale_deg: float) -> Map:
        """Smooth noise of about unit variance: a sum of waves in directions and phases that are always the same."""
        random = np.random.default_rng(SEED)
        waves = random.normal(size=(24, 3)) * 60 / scale_deg
        phases = random.uniform(0, 2 * np.pi, 24)
        return np.asarray(np.sin(self.unit @ waves.T + phases).sum(axis=-1) / np.sqrt(12))


def helmet_glb() -> bytes:
    """Generates the file."""
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    rows, columns = TEXTURE
    texels = Directions.grid(
        90 - 180 * (np.arange(rows) + 0.5) / rows, 360 * (np.arange(columns) + 0.5) / columns - 180
    )
    material = PBRMaterial(name=NAME, metallicFactor=1.0, roughnessFactor=1.0, emissiveFactor=[1.0] * 3)
    for name, picture in _textures(texels).items():
        setattr(material, name, _image(picture))
    mesh, uv = _mesh()
    mesh.visual = TextureVisuals(uv=uv, material=material)
    return glb(mesh, {NAME: LAMP_RADIANCE})


def _image(picture: Picture) -> Any:  # noqa: ANN401 - Pillow is imported where it is needed
    from PIL import Image

    return Image.fromarray(picture)


def _step(value: Map, width: float) -> Map:
    """Returns 0 below -width, 1 above width, and a smooth way between them."""
    weight = np.clip(0.5 + value / (2 * width), 0, 1)
    return weight * weight * (3 - 2 * weight)


def _radius_m(at: Directions) -> Map:
    """Returns the shell's distance from the middle: an ellipsoid with visor, ridge and ears."""
    shell = 1 / np.linalg.norm(at.unit / RADII_M, axis=-1)
    shell += INSET_M * (0.6 * _step(0.16 - np.abs(at.visor - 1.06), 0.08) - _step(0.93 - at.visor, 0.08))
    shell += RIDGE_M * _step(STRIPE_DEG - at.across, 3.0) * _step(at.elevation - 32.0, 8.0)
    shell += EAR_M * _step(EAR_DEG - at.ear, 3.0)
    return np.asarray(shell)


def _mesh() -> "tuple[trimesh.Trimesh, Float64[np.ndarray, 'n 2']]":
    """Returns the shell and its texture coordinates; the first and the last column lie on each other."""
    import trimesh

    elevations = np.linspace(90, CUT_DEG, ROWS - 2)
    azimuths = np.linspace(-180, 180, COLUMNS + 1)
    at = Directions.grid(elevations, azimuths)
    points = at.unit * _radius_m(at)[..., None]
    below = points[-1] * [0.0, 0.0, 1.0] - [0, 0, NECK_DROP_M]
    level = at.unit[-1] / np.linalg.norm(at.unit[-1, :, :2], axis=-1, keepdims=True) * [1, 1, 0]
    points = np.concatenate([points, [below + level * NECK_RADIUS_M], [below]])
    v = np.concatenate([(elevations + 90) / 180, [0.02, 0.0]])
    u = azimuths / 360 + 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    mesh = trimesh.Trimesh(
        points.reshape(-1, 3), _faces(ROWS, COLUMNS + 1), vertex_normals=_normals(points), process=False
    )
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return mesh, uv


def _faces(rows: int, columns: int) -> Any:  # noqa: ANN401 - index arrays
    """Returns the triangles of a grid, outward; those that a pole makes a line of are left out."""
    row, column = (each.ravel() for each in np.indices((rows - 1, columns - 1)))
    a, b = row * columns + column, row * columns + column + 1
    c, d = a + columns, b + columns
    upper, lower = np.stack([a, d, b], 1), np.stack([a, c, d], 1)
    return np.concatenate([upper[row > 0], lower[row < rows - 2]])


def _normals(points: Float64[np.ndarray, "r c 3"]) -> Float64[np.ndarray, "n 3"]:
    """Returns unit normals by the differences of neighbours, the seam's included."""
    around = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
    along, down = around[:, 2:] - around[:, :-2], np.gradient(points, axis=0)
    normals = np.cross(down, along)
    normals[0], normals[-1] = (0, 0, 1), (0, 0, -1)
    return np.asarray((normals / np.linalg.norm(normals, axis=-1, keepdims=True)).reshape(-1, 3))


def _textures(at: Directions) -> dict[str, Picture]:
    """Returns the pictures by what glTF calls them."""
    is_visor, is_rim = _step(0.95 - at.visor, 0.01), _step(RIM_WIDTH - np.abs(at.visor - 1.05), 0.02)
    is_ear, is_stripe = _step(EAR_DEG - at.ear, 0.5), at.stripe
    wear = _step(at.noise(5.0) + 0.8 * is_rim + 0.7 * at.noise(1.6) - 2.3, 0.2) * (1 - is_visor)
    lines = _line_mask(at) * (1 - is_visor) * (1 - is_ear)
    color = np.broadcast_to(PAINT, (*at.azimuth.shape, 3)) * (1 + 0.04 * at.noise(12.0))[..., None]
    metal, rough = np.zeros_like(at.azimuth), 0.42 + 0.05 * at.noise(8.0)
    layers = (
        (is_stripe, STRIPE, 0.0, 0.38),
        (is_rim, RUBBER, 0.0, 0.75),
        (is_ear, RUBBER, 0.0, 0.7),
        (lines, (0.08, 0.08, 0.085), 0.0, 0.8),
        (wear, STEEL, 1.0, 0.32),
        (is_visor, GOLD, 1.0, 0.07),
    )
    for weight, layer, layer_metal, layer_rough in layers:
        color = color + (np.asarray(layer) - color) * weight[..., None]
        metal = metal + (layer_metal - metal) * weight
        rough = rough + (layer_rough - rough) * weight
    occlusion = 1 - 0.5 * np.maximum(lines, is_rim * 0.6)
    return {
        "baseColorTexture": _bytes(srgb_code(color)),
        "metallicRoughnessTexture": _bytes(np.stack([occlusion, rough, metal], axis=-1)),
        "normalTexture": _normal_map(_height_m(at, lines), at),
        "emissiveTexture": _bytes(srgb_code(_lamps(at)[..., None] * LAMP)),
    }


def _line_mask(at: Directions) -> Map:
    """Returns 1 in the grooves between the shell's panels."""
    level = np.min([np.abs(at.elevation - each) for each in PANEL_LINES_DEG], axis=0)
    upright = np.where(
        (at.elevation < PANEL_LINES_DEG[1]) & (np.abs(at.azimuth) > 115),
        np.abs(np.abs(at.azimuth) - 130) * np.cos(np.radians(at.elevation)),
        np.inf,
    )
    return _step(LINE_DEG - np.minimum(level, upright), 0.4)


def _lamps(at: Directions) -> Map:
    """Returns 1 where it glows: a ring on each ear, and three lamps above the visor."""
    ring = _step(0.9 - np.abs(at.ear - 0.62 * EAR_DEG), 0.4)
    beside = np.min([np.abs(at.azimuth - each) for each in (-7.0, 0.0, 7.0)], axis=0)
    return np.asarray(np.maximum(ring, _step(1.5 - np.hypot(beside, at.elevation - 30.5), 0.4)))


def _height_m(at: Directions, lines: Map) -> Map:
    """Returns what the normal map shows: grooves, rivets beside the level ones, and an uneven paint."""
    beside = np.abs((at.azimuth + 7.5) % 15 - 7.5) * np.cos(np.radians(at.elevation))
    rivets = np.zeros_like(at.azimuth)
    for line in PANEL_LINES_DEG:
        rivets = np.maximum(rivets, _step(1.1 - np.hypot(beside, at.elevation - line - 4), 0.5))
    rivets *= (at.visor > 1.25) & (at.ear > EAR_DEG + 3)
    paint = _step(at.visor - 1.2, 0.02) * 0.00004 * at.noise(2.5)
    return np.asarray(RIVET_HEIGHT_M * rivets - LINE_DEPTH_M * lines + paint)


def _normal_map(height_m: Map, at: Directions) -> Picture:
    """Returns tangent-space normals (glTF 2.0, 3.9.3): x along the columns, y up the rows."""
    rows, columns = height_m.shape
    radius_m = float(np.mean(RADII_M))
    around_m = 2 * np.pi * radius_m / columns * np.maximum(np.cos(np.radians(at.elevation)), 0.05)
    wrapped = np.concatenate([height_m[:, -1:], height_m, height_m[:, :1]], axis=1)
    slope_x = (wrapped[:, 2:] - wrapped[:, :-2]) / (2 * around_m)
    slope_y = -np.gradient(height_m, axis=0) / (np.pi * radius_m / rows)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(height_m)], axis=-1)
    return _bytes(0.5 + 0.5 * normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def _bytes(values: Float64[np.ndarray, "h w 3"]) -> Picture:
    return np.asarray(np.round(255 * np.clip(values, 0, 1)), np.uint8)
