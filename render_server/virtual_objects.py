"""The scene document's objects as one set of triangles in the world."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from protocol.board import BoardSpec
from protocol.errors import DeltalightError
from protocol.scene_objects import Material as MaterialDocument
from protocol.scene_objects import SceneObject
from render_server.gpu.context import GpuContext
from render_server.passes.materials import MaterialTable
from render_server.passes.mesh_buffers import MeshBuffers, triangle_corners
from render_server.relight.frame import GeometryState
from render_server.scene.materials import Material
from render_server.scene.mesh import TriangleMesh, load_mesh, merge_for_gpu

MARKER_FRAME = "marker:"


class VirtualObjects:
    """Loads assets once, moves them when the document does."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._assets: dict[str, list[TriangleMesh]] = {}
        self._buffers = MeshBuffers(gpu)
        self._materials: MaterialTable | None = None
        self._shown: tuple[SceneObject, ...] = ()
        self._board: BoardSpec | None = None
        self._version = 0
        self.state: GeometryState | None = None

    def load(self, objects: Sequence[SceneObject]) -> None:
        """Read the assets of all visible objects now, so that a bad file is found before the first frame.

        Raises:
            DeltalightError: an asset cannot be read, or a material that this release lacks.
        """
        for item in objects:
            if item.visible and item.asset not in self._assets:
                self._assets[item.asset] = load_mesh(Path(item.asset))
            if item.material is not None and not isinstance(item.material, MaterialDocument):
                raise DeltalightError(
                    f"object `{item.id}`: precomputed materials arrive with a later release; give base_color instead."
                )

    def update(self, objects: Sequence[SceneObject], board: BoardSpec | None) -> GeometryState | None:
        """The visible objects' triangles; None if there are none."""
        shown = tuple(item for item in objects if item.visible)
        if shown == self._shown and board == self._board:
            return self.state
        self._shown, self._board = shown, board
        self._version += 1
        self.state = self._build(shown, board) if shown else None
        return self.state

    def _build(self, shown: tuple[SceneObject, ...], board: BoardSpec | None) -> GeometryState:
        meshes = [mesh for item in shown for mesh in self._placed(item, board)]
        merged = merge_for_gpu(meshes)
        self._buffers.write(merged)
        if self._materials is not None:
            self._materials.release()
        self._materials = MaterialTable(self._gpu, merged)
        points = np.vstack([_box_corners(mesh.bounds()) for mesh in meshes])
        return GeometryState(self._version, self._buffers, triangle_corners(merged), points, self._materials)

    def _placed(self, item: SceneObject, board: BoardSpec | None) -> list[TriangleMesh]:
        """An object's meshes in the world, with the document's material if it gives one."""
        matrix = world_from_frame(item, board) @ item.world_from_object()
        meshes = [mesh.transformed(matrix) for mesh in self._assets[item.asset]]
        if not isinstance(item.material, MaterialDocument):
            return meshes
        material = Material.from_document(item.material)
        return [replace(mesh, material=material, colors=None) for mesh in meshes]

    def release(self) -> None:
        """Free the GL objects."""
        self._buffers.release()
        if self._materials is not None:
            self._materials.release()


def world_from_frame(item: SceneObject, board: BoardSpec | None) -> Float64[np.ndarray, "4 4"]:
    """Frame that an object's pose refers to: the world, or a marker of the board (origin at its top-left corner)."""
    matrix = np.eye(4)
    if not item.frame.startswith(MARKER_FRAME):
        return matrix
    marker = int(item.frame.removeprefix(MARKER_FRAME))
    corners = board.corner_points() if board is not None else {}
    if marker not in corners:
        raise DeltalightError(
            f"object `{item.id}` stands on marker {marker}, which the board does not have: "
            "use `frame: world` or one of the board's ids."
        )
    matrix[:3, 3] = corners[marker][0]
    return matrix


def _box_corners(bounds: np.ndarray) -> Float64[np.ndarray, "8 3"]:
    """Eight corners of a box given as (least, greatest)."""
    picks = np.array([[(index >> axis) & 1 for axis in range(3)] for index in range(8)])
    return np.asarray(np.asarray(bounds, np.float64)[picks, np.arange(3)])
