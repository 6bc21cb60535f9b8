"""The real scene as a mesh for people to look at: its triangles, with the newest picture on those that it shows."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from deltalight.protocol.files import write_bytes
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.view import CameraView

if TYPE_CHECKING:
    import trimesh

# A corner that lies farther behind the measured surface than this fraction of its distance is hidden by it: a few
# standard deviations of depth cameras, and what meshing rounds off.
HIDDEN_FRACTION = 0.03
# Longest edge of a triangle, m and relative to the room: the picture is laid on whole triangles, straight on each.
EDGE_M, EDGE_FRACTION = 0.1, 1 / 48
SEEN, UNSEEN = "room", "room out of sight"
UNSEEN_CODE = 96  # dark grey
UNLIT_EXTENSION = "KHR_materials_unlit"  # the picture has the room's light in it
Y_FROM_Z = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # glTF: y is up

Corners = Float32[np.ndarray, "m 3 3"]


@dataclass(frozen=True, eq=False)
class RoomMesh:
    """Triangles by corners (world, m), places in the picture (0..1, from its upper left), and which it shows."""

    corners: Corners
    places: Float64[np.ndarray, "m 3 2"]
    is_seen: Bool[np.ndarray, " m"]
    picture: UInt8[np.ndarray, "h w 3"]

    def write(self, path: Path) -> None:
        """Writes it as a GLB file, y up.

        Raises:
            DeltalightError: the disk refuses.
        """
        import trimesh

        scene = trimesh.Scene()
        for name, chosen in ((SEEN, self.is_seen), (UNSEEN, ~self.is_seen)):
            if chosen.any():
                scene.add_geometry(self._part(name, chosen), node_name=name, geom_name=name)
        scene.apply_transform(Y_FROM_Z)
        write_bytes(path, scene.export(file_type="glb", tree_postprocessor=_unlit))

    def _part(self, name: str, chosen: Bool[np.ndarray, " m"]) -> "trimesh.Trimesh":
        """Returns the chosen triangles with the picture, or grey."""
        import trimesh
        from PIL import Image
        from trimesh.visual import TextureVisuals
        from trimesh.visual.material import PBRMaterial

        rows = np.concatenate([self.corners[chosen], self.places[chosen]], axis=-1).reshape(-1, 5)
        if name == UNSEEN:
            rows[:, 3:] = 0
        vertices, numbers = np.unique(rows.astype(np.float32), axis=0, return_inverse=True)
        shown = {"baseColorTexture": Image.fromarray(self.picture)} if name == SEEN else {}
        grey = [255] * 4 if name == SEEN else [UNSEEN_CODE] * 3 + [255]
        material = PBRMaterial(
            name=name, baseColorFactor=grey, metallicFactor=0.0, roughnessFactor=1.0, **shown
        )
        uv = vertices[:, 3:] * [1, -1] + [0, 1]  # trimesh counts from the lower left
        visual = TextureVisuals(uv=uv, material=material)
        faces = numbers.reshape(-1, 3)
        return trimesh.Trimesh(vertices[:, :3], faces, visual=visual, process=False)


def room_mesh(corners: Corners, frame: ViewFrame, view: CameraView) -> RoomMesh:
    """Lays a frame's picture on triangles of the world.

    A triangle is seen if the picture shows its three corners, and no measured surface is before them.
    """
    corners = _divided(corners)
    points = corners.reshape(-1, 3).astype(np.float64)
    inverse = view.camera_from_world
    seen_from = points @ inverse[:3, :3].T + inverse[:3, 3]
    pixels = view.camera.project(seen_from)
    size = np.array(view.size)
    places = (pixels + 0.5) / size
    with np.errstate(invalid="ignore"):  # points behind the camera have no pixel
        is_inside = np.all((places >= 0) & (places < 1), axis=1)
    if frame.depth is not None:
        column, row = np.where(is_inside[:, None], pixels + 0.5, 0).astype(int).T
        before_m = frame.depth.depth_m[row, column]
        is_hidden = frame.depth.valid[row, column] & (seen_from[:, 2] > before_m * (1 + HIDDEN_FRACTION))
        is_inside &= ~is_hidden
    places = np.where(is_inside[:, None], places, 0)
    return RoomMesh(corners, places.reshape(-1, 3, 2), is_inside.reshape(-1, 3).all(axis=1), frame.color)


def _divided(corners: Corners) -> Corners:
    """Divides triangles of a model that are large for a room of its size."""
    from trimesh.remesh import subdivide_to_size

    longest_m = max(EDGE_M, EDGE_FRACTION * float(np.ptp(corners.reshape(-1, 3), axis=0).max()))
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    if edges.max() <= longest_m:
        return corners
    points, faces = subdivide_to_size(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), longest_m, max_iter=16
    )
    return np.asarray(points[faces], np.float32)


def _unlit(tree: dict[str, Any]) -> None:
    for material in tree["materials"]:
        material["extensions"] = {UNLIT_EXTENSION: {}}
    tree["extensionsUsed"] = [UNLIT_EXTENSION]
