"""The parts of a benchmark scene; `scenes/` holds one file per scene."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.lamps import Lamp
from deltalight.benchmarks.ground_truth.parts import Matrix, MeshFolder, Triple
from deltalight.benchmarks.ground_truth.render import MAX_DEPTH
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel

CAMERA = CameraModel(
    width=640,
    height=480,
    matrix=np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]]),
    distortion_model="plumb_bob",
    distortion=np.zeros(5),
)
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.04,
    separation_m=0.01,
    rows=3,
    columns=4,
    first_id=0,
    white_albedo=0.8,
)
TABLE_Z_M = -0.0005
"""The board's sheet has a thickness; its printed side is z = 0."""


@dataclass(frozen=True)
class Finish:
    """Material of a virtual object in the scene document's terms (docs/formats.md 3); linear colours.

    `metallic` 0 with `specular` 0 is Lambertian; metals and dielectrics have a GGX lobe. `transmission` is 0, or 1
    for smooth glass.
    """

    base_color: Triple
    roughness: float = 0.5
    metallic: float = 0.0
    specular: float = 0.5
    emission: Triple = (0.0, 0.0, 0.0)
    transmission: float = 0.0


@dataclass(frozen=True)
class VirtualObject:
    """A virtual object: its mesh (own frame, metres, z up), material, and pose in each frame (rigid)."""

    id: str
    mesh: Callable[[], trimesh.Trimesh]
    finish: Finish
    world_from_object: tuple[Matrix, ...]


@dataclass(frozen=True)
class ShadowEdge:
    """A straight path on a real surface across the edge of a virtual object's shadow: from light into shadow.

    The fraction of direct light along it falls from 1 to 0; the distance between 90 % and 10 % is the penumbra's
    width.
    """

    start_m: Triple
    end_m: Triple


@dataclass(frozen=True, eq=False)
class BenchmarkScene:
    """A real room, virtual objects in it, and the scene document's description of both.

    `real` creates the Mitsuba shapes of the room without lights. `environment` is a latitude-longitude map (linear,
    row 0 up = +z, centre column looks along +x, +y is to its left, as render_server/lights/environment.py reads it);
    a scene has either lamps or a map. `max_depth` limits the truth's light paths, in segments. `surfaces` is the
    document's `real.surfaces`. `world_from_camera` and every object's poses have one entry per frame.
    """

    name: str
    title: str
    world_from_camera: tuple[Matrix, ...]
    real: Callable[[MeshFolder], dict[str, Any]]
    objects: tuple[VirtualObject, ...]
    lamps: tuple[Lamp, ...] = ()
    environment: Callable[[], Float32[np.ndarray, "h w 3"]] | None = None
    surfaces: tuple[dict[str, Any], ...] = ()
    camera: CameraModel = CAMERA
    board: BoardSpec = BOARD
    shadow_edges: tuple[ShadowEdge, ...] = ()
    max_depth: int = MAX_DEPTH
    settings: dict[str, Any] = field(default_factory=dict)
    """Further settings of `method` that the scene needs (volume_edge_m)."""

    @property
    def frame_count(self) -> int:
        """Number of frames of the take."""
        return len(self.world_from_camera)
