"""Objects that every service has: simple shapes of plain materials, and three models, as GLB files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deltalight.services.storage.faults import NotFoundError
from deltalight.services.storage.shelf_glb import glb
from deltalight.services.storage.shelf_helmet import helmet_glb
from deltalight.services.storage.shelf_lantern import lantern_glb

if TYPE_CHECKING:
    import trimesh

BALL_RADIUS_M = 0.06
CUBE_EDGE_M = 0.1
RING_RADII_M = (0.045, 0.012)  # of the ring and of its wire
SECTIONS = 64  # of what is round: sides of a polygon that looks like a circle
BALL_SUBDIVISIONS = 4
VASE_HEIGHT_M, VASE_WALL_M = 0.18, 0.004
VASE_RINGS = 21
FIGURE = Path(__file__).parents[1] / "demo_assets" / "figure.glb"  # made by benchmarks/walking_figure.py


@dataclass(frozen=True)
class ShelfModel:
    """A file that is more than a shape of one material; `clip` plays from the beginning, None = nothing moves."""

    name: str
    label: str
    glb: Callable[[], bytes]
    clip: str | None = None

    @property
    def file_name(self) -> str:
        """The name of its file."""
        return f"{self.label}.glb"


@dataclass(frozen=True)
class ShelfItem:
    """A shape (z up, metres) and its material: linear base colour, metallic, roughness (glTF 2.0, 3.9.2)."""

    name: str
    label: str
    shape: "Callable[[], trimesh.Trimesh]"
    base_color: tuple[float, float, float]
    metallic: float
    roughness: float
    clip = None  # nothing moves

    @property
    def file_name(self) -> str:
        """The name of its file."""
        return f"{self.label}.glb"

    def glb(self) -> bytes:
        """Generates the file; the same bytes each time."""
        from trimesh.visual import TextureVisuals
        from trimesh.visual.material import PBRMaterial

        mesh = self.shape()
        material = PBRMaterial(
            name=self.label,
            baseColorFactor=[*self.base_color, 1.0],
            metallicFactor=self.metallic,
            roughnessFactor=self.roughness,
        )
        mesh.visual = TextureVisuals(material=material)
        return glb(mesh)


def _ball() -> "trimesh.Trimesh":
    from trimesh.creation import icosphere

    return icosphere(subdivisions=BALL_SUBDIVISIONS, radius=BALL_RADIUS_M)


def _cube() -> "trimesh.Trimesh":
    from trimesh.creation import box

    return box((CUBE_EDGE_M,) * 3)


def _vase() -> "trimesh.Trimesh":
    from trimesh.creation import revolve

    up = np.linspace(0, 1, VASE_RINGS)
    radius_m = 0.04 + 0.016 * np.sin(2 * np.pi * (1.05 * up - 0.08))  # foot, belly, neck and rim
    outside = np.column_stack([radius_m, VASE_HEIGHT_M * up])
    inside = outside[::-1] - [VASE_WALL_M, 0]
    inside[-1, 1] = VASE_WALL_M  # the bottom
    wall = [[0.0, 0.0], *outside, *inside, [0.0, VASE_WALL_M]]
    return revolve(np.array(wall), sections=SECTIONS)


def _ring() -> "trimesh.Trimesh":
    from trimesh.creation import torus

    return torus(*RING_RADII_M, major_sections=SECTIONS, minor_sections=SECTIONS // 2)


def _cylinder() -> "trimesh.Trimesh":
    from trimesh.creation import cylinder

    return cylinder(radius=0.04, height=0.12, sections=SECTIONS)


def _cone() -> "trimesh.Trimesh":
    from trimesh.creation import cone

    return cone(radius=0.05, height=0.12, sections=SECTIONS)


def _plate() -> "trimesh.Trimesh":
    from trimesh.creation import box

    return box((0.18, 0.12, 0.005))


# Colours of chromium and gold as tabulated for physically based materials (documentation of Unreal Engine).
# Chrome and grey ball are those that record the light of a film set.
SHELF: dict[str, ShelfItem | ShelfModel] = {
    item.name: item
    for item in (
        ShelfModel("walking-figure", "Walking figure", FIGURE.read_bytes, clip="round"),
        ShelfModel("glowing-lantern", "Glowing lantern", lantern_glb),
        ShelfModel("helmet", "Helmet", helmet_glb),
        ShelfItem("chrome-ball", "Chrome ball", _ball, (0.55, 0.556, 0.554), metallic=1.0, roughness=0.05),
        ShelfItem("grey-ball", "Grey ball", _ball, (0.18, 0.18, 0.18), metallic=0.0, roughness=1.0),
        ShelfItem("matte-cube", "Matte cube", _cube, (0.8, 0.8, 0.8), metallic=0.0, roughness=1.0),
        ShelfItem("glazed-vase", "Glazed vase", _vase, (0.03, 0.12, 0.3), metallic=0.0, roughness=0.12),
        ShelfItem("cylinder", "Cylinder", _cylinder, (0.5, 0.5, 0.5), metallic=0.0, roughness=0.6),
        ShelfItem("cone", "Cone", _cone, (0.5, 0.5, 0.5), metallic=0.0, roughness=0.6),
        ShelfItem("plate", "Plate", _plate, (0.5, 0.5, 0.5), metallic=0.0, roughness=0.6),
        ShelfItem("gold-ring", "Gold ring", _ring, (1.0, 0.766, 0.336), metallic=1.0, roughness=0.2),
    )
}


def shelf_item(name: str) -> ShelfItem | ShelfModel:
    """Returns an object of the shelf.

    Raises:
        NotFoundError: there is none of this name.
    """
    if name not in SHELF:
        raise NotFoundError(f"there is no '{name}' on the shelf; it has {', '.join(SHELF)}.")
    return SHELF[name]
