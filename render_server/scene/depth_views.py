"""Depth images of several cameras in one room: which of them shows a surface largest, and where they see nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from deltalight.render_server.scene.depth_mesh import stride_for_budget
from deltalight.render_server.scene.depth_surface import DepthSurface, jump_terms_of
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import NEAR_M, CameraView

# Relative to depth: how far a point may be from what a camera sees there. The same as for surfels (lighting.py).
SAME_DEPTH = 0.02

Points = Float64[np.ndarray, "n 3"]
Columns = Float64[np.ndarray, "3 n"]  # of points: NumPy is slow along short rows
Mask = Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class PosedSurface:
    """The surface of a depth image and the view that it was taken from.

    `noise_sigma`: depth noise at 1 m, m. `aligns`: the pose may err by what a marker board leaves open.
    """

    surface: DepthSurface
    view: CameraView
    noise_sigma: float
    aligns: bool = False

    def covered(self, stride: int) -> Bool[np.ndarray, "h w"]:
        """Returns the pixels that a mesh of cells of `stride` pixels covers: known around, and without a jump."""
        inverse = self.surface.inverse_depth
        kernel = np.ones((2 * stride + 1,) * 2, np.uint8)
        known = (inverse > 0) & np.isfinite(self.surface.gradient[0])
        slope, least = jump_terms_of(self.noise_sigma, self.view.camera)
        step = cv2.dilate(inverse, kernel) - cv2.erode(inverse, kernel)
        whole = cv2.erode(known.astype(np.uint8), kernel) > 0
        return np.asarray(whole & (step <= inverse * np.float32(slope * 2 * stride) + np.float32(least)))

    def find(self, points: Columns) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Returns the depth of world points along the optical axis, m, and the pixel (flat index) that shows each;
        -1: none does.
        """
        matrix, camera = self.view.camera_from_world, self.view.camera
        local = np.einsum("ij,jn->in", matrix[:3, :3], points) + matrix[:3, 3:]
        ahead = np.flatnonzero(local[2] > NEAR_M)
        column, row = camera.project(local.take(ahead, axis=1).T).T + 0.5
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        pixel = np.full(points.shape[1], -1)
        pixel[ahead[inside]] = row[inside].astype(int) * camera.width + column[inside].astype(int)
        return local[2], pixel

    def pixels_per_area(self, points: Columns, normals: Columns) -> Float64[np.ndarray, " n"]:
        """Returns on how many pixels (1/m^2) surfaces are shown: fx fy |n.c| / z^3; 0 from behind."""
        fx, fy = self.view.camera.matrix[[0, 1], [0, 1]]
        to_eye = self.view.position[:, None] - points
        facing = np.einsum("in,in->n", normals, to_eye)
        z = np.maximum(np.einsum("i,in->n", -self.view.world_from_camera[:3, 2], to_eye), NEAR_M)
        return np.asarray(fx * fy * np.maximum(facing, 0) / (z * z * z))

    def shows(
        self, depth_m: Float64[np.ndarray, " n"], pixel: Int64[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Returns whether a surface is shown at the depth of each point; arguments are what `find` returns."""
        inverse = self.surface.inverse_depth.ravel()[pixel]
        return np.asarray((pixel >= 0) & (inverse > 0) & (np.abs(inverse * depth_m - 1) < SAME_DEPTH))


@dataclass(frozen=True, eq=False)
class DepthViews:
    """Depth images of one room at one moment."""

    frames: tuple[PosedSurface, ...]

    def without_copies(self, meshes: Sequence[TriangleMesh], triangle_budget: int) -> list[TriangleMesh]:
        """Returns the meshes (one of each frame, within that budget) without triangles that another shows larger.

        Surfaces that several cameras see would otherwise count several times as light and as obstacle. A triangle
        goes if others show all of its corners larger, so that meshes overlap where they meet.
        """
        if len(self.frames) == 1:
            return list(meshes)
        cameras = [frame.view.camera for frame in self.frames]
        strides = [stride_for_budget(each.width, each.height, triangle_budget) for each in cameras]
        covered = [frame.covered(stride).ravel() for frame, stride in zip(self.frames, strides, strict=True)]
        return [self._without_copies(index, mesh, covered) for index, mesh in enumerate(meshes)]

    def _without_copies(
        self, index: int, mesh: TriangleMesh, covered: Sequence[Bool[np.ndarray, " p"]]
    ) -> TriangleMesh:
        points, normals = _columns(mesh.positions), _columns(mesh.normals)
        own = self.frames[index].pixels_per_area(points, normals)
        copied = np.zeros(len(own), bool)
        for number, other in enumerate(self.frames):
            if number == index:
                continue
            shown = other.pixels_per_area(points, normals)
            larger = np.flatnonzero(shown >= own if number < index else shown > own)
            depth_m, pixel = other.find(points.take(larger, axis=1))
            copied[larger] |= covered[number].take(pixel) & other.shows(depth_m, pixel)
        one, two, three = copied.take(mesh.triangles).T
        return replace(mesh, triangles=mesh.triangles.take(np.flatnonzero(~(one & two & three)), axis=0))

    def count_showing(self, points: Points) -> Int64[np.ndarray, " n"]:
        """Returns how many frames show a surface at each point."""
        columns = _columns(points)
        return np.asarray(sum(each.shows(*each.find(columns)).astype(np.int64) for each in self.frames))

    def in_free_space(self, points: Points) -> Mask:
        """Returns which points lie before what a camera sees: nothing is there."""
        free, columns = np.zeros(len(points), bool), _columns(points)
        for frame in self.frames:
            depth_m, pixel = frame.find(columns)
            inverse = frame.surface.inverse_depth.ravel()[pixel]
            free |= (pixel >= 0) & (inverse > 0) & (inverse * depth_m < 1 - SAME_DEPTH)
        return free


def _columns(points: Float64[np.ndarray, "n 3"] | Float32[np.ndarray, "n 3"]) -> Columns:
    return np.ascontiguousarray(points.T, np.float64)
