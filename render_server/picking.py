"""Picking: what a pixel of the newest picture shows, an object or a point of the real scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.frame_graph import ShownBuffers
from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.gpu.textures import read_texel
from deltalight.render_server.scene.bvh import first_hit
from deltalight.render_server.scene.depth_surface import depth_surface
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import CameraView

SHOWN_FRACTION = 0.5  # of a pixel that an object must cover to be picked

Vector = Float64[np.ndarray, "3"]
Pixel = tuple[int, int]
Texels = Int64[np.ndarray, "h w"]
Surface = tuple[Vector, Vector]  # position, m; normal


@dataclass(frozen=True, eq=False)
class Pick:
    """What a pixel of frame `frame_id` shows.

    Position (world, m), unit normal, distance (m) unless `nothing`.
    `object_id` is the scene document's, if a virtual object is in front. The normal faces the camera.
    """

    frame_id: int
    kind: Literal["real", "object", "nothing"]
    object_id: str | None = None
    point_m: Vector | None = None
    normal: Vector | None = None
    distance_m: float | None = None

    def as_dict(self) -> dict[str, object]:
        """Returns the pick as plain data."""
        return {
            "frame_id": self.frame_id,
            "kind": self.kind,
            "object": self.object_id,
            "point_m": None if self.point_m is None else self.point_m.tolist(),
            "normal": None if self.normal is None else self.normal.tolist(),
            "distance_m": self.distance_m,
        }


@dataclass(frozen=True, eq=False)
class ShownFrame:
    """The last rendered frame, at the picture's size.

    `view` holds its camera and pose; None without a pose, or if the picture is not the camera's. `buffers`
    are its geometry buffers, of an enlarged picture smaller ones; None if the scene shows no object. `model` is the
    real scene's, if given.
    """

    frame: ViewFrame
    view: CameraView | None
    buffers: ShownBuffers | None
    model: Sequence[TriangleMesh] = ()

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"] | None:
        """The pose that the picture was rendered with."""
        return None if self.view is None else self.view.world_from_camera

    def pick(self, x: float, y: float, ignore: str | None = None) -> Pick:
        """Returns what the pixel around (x, y) shows; pixel centres are at integers.

        The object `ignore` (an id) is transparent to the pick.

        Raises:
            DeltalightError: the pixel lies outside of the picture, or the picture has no pose.
        """
        camera = self.frame.camera
        pixel = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        if not (0 <= pixel[0] < camera.width and 0 <= pixel[1] < camera.height):
            raise DeltalightError(
                f"The pixel ({x:g}, {y:g}) lies outside of the picture of {camera.width}x{camera.height}; "
                "name one inside."
            )
        if self.view is None:
            raise DeltalightError(
                "The newest picture has no place in the world (no marker board in view, or a view that is not the "
                "camera's); show the board, or another view."
            )
        owner, found = self._surface_at(self.view, pixel, ignore)
        if found is None:
            return Pick(self.frame.frame_id, "nothing")
        point, normal = found
        distance_m = float(np.linalg.norm(point - self.view.position))
        kind: Literal["real", "object"] = "real" if owner is None else "object"
        return Pick(self.frame.frame_id, kind, owner, point, normal / np.linalg.norm(normal), distance_m)

    def _surface_at(
        self, view: CameraView, pixel: Pixel, ignore: str | None
    ) -> tuple[str | None, Surface | None]:
        """Returns the id of the object in front, if it counts, and the surface there."""
        if self.buffers is None:
            return None, self._in_frame(view, pixel)
        whole, held = (self.frame.camera.width, self.frame.camera.height), self.buffers.view.size
        pixel = pixel[0] * held[0] // whole[0], pixel[1] * held[1] // whole[1]
        owner = _object_in_front(self.buffers, pixel)
        if owner == ignore:
            owner = None
        return owner, _surface_in_buffers(self.buffers, pixel, of_object=owner is not None)

    def _in_frame(self, view: CameraView, pixel: Pixel) -> Surface | None:
        """Returns the real surface without buffers: of the given model, or of the frame's own depth."""
        rotation = view.world_from_camera[:3, :3]
        ray = np.array([*view.camera.unproject(np.array([pixel], np.float64))[0], 1.0])
        if self.model:
            corners = np.concatenate([mesh.positions[mesh.triangles] for mesh in self.model])
            hit = first_hit(corners, view.position, rotation @ ray)
            return None if hit is None else (view.position + hit[0] * (rotation @ ray), hit[1])
        depth = self.frame.depth
        if depth is None or not depth.valid[pixel[1], pixel[0]] or depth.depth_m[pixel[1], pixel[0]] <= 0:
            return None
        fitted = depth_surface(depth, view.camera).normals[pixel[1], pixel[0]].astype(np.float64)
        point = view.position + rotation @ (ray * float(depth.depth_m[pixel[1], pixel[0]]))
        return point, rotation @ (fitted if fitted.any() else -ray)


def _object_in_front(shown: ShownBuffers, pixel: Pixel) -> str | None:
    """Returns the id of the virtual object that the pixel shows."""
    if read_texel(shown.object_coverage, pixel)[0] < SHOWN_FRACTION:
        return None
    material = read_texel(shown.object_buffer.normal, _raster_texel(shown.view, pixel))[3]
    return _owner(shown.objects.objects, round(float(material)))


def _surface_in_buffers(shown: ShownBuffers, pixel: Pixel, *, of_object: bool) -> Surface | None:
    """Returns position and normal from one geometry buffer; None where the real surface is unknown."""
    texel = _raster_texel(shown.view, pixel) if of_object else pixel
    buffer = shown.object_buffer if of_object else shown.real_surface
    place = read_texel(buffer.position, texel).astype(np.float64)
    if place[3] <= 0:
        return None
    return place[:3], read_texel(buffer.normal, texel)[:3].astype(np.float64)


def raster_texels(view: CameraView) -> tuple[Texels, Texels]:
    """Returns column and row in the objects' raster that each pixel sees (passes/shaders/common/geometry.glsl)."""
    if view.antialiased or not view.camera.has_distortion:
        row, column = np.indices(view.size[::-1])
        return column, row
    (fx, fy, cx, cy), _ = view.raster
    x, y = np.moveaxis(view.camera.rays(), -1, 0)
    return np.floor(fx * x + cx + 0.5).astype(np.int64), np.floor(fy * y + cy + 0.5).astype(np.int64)


def _raster_texel(view: CameraView, pixel: Pixel) -> Pixel:
    column, row = (int(texels[pixel[1], pixel[0]]) for texels in raster_texels(view))
    return column, row


def _owner(objects: Sequence[PlacedObject], material: int) -> str:
    """Returns the id of the object that a merged material (one per mesh, in order) belongs to."""
    ends = np.cumsum([len(item.meshes) for item in objects])
    return objects[int(np.searchsorted(ends, material, side="right"))].id
