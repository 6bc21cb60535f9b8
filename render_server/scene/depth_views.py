"""Depth images of several cameras in one room: which of them shows a surface largest, and where they see nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from deltalight.protocol import short_axis
from deltalight.render_server.scene.depth_mesh import stride_for_budget
from deltalight.render_server.scene.depth_surface import DepthSurface, jump_terms_of
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import NEAR_M, CameraView

# Relative to depth: how far a point may be from what a camera sees there. The same as for surfels (lighting.py).
SAME_DEPTH = 0.02

Points = Float64[np.ndarray, "n 3"]
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

    def find(self, points: Points) -> tuple[Points, Int64[np.ndarray, " n"]]:
        """Returns world points in the optical frame, and the pixel (flat index) that shows each; -1: none does."""
        matrix, camera = self.view.camera_from_world, self.view.camera
        local = np.einsum("ni,ji->nj", points, matrix[:3, :3]) + matrix[:3, 3]
        ahead = local[:, 2] > NEAR_M
        pixel = np.full(len(points), -1)
        column, row = np.floor(np.nan_to_num(camera.project(local[ahead]), nan=-1.0) + 0.5).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        pixel[ahead] = np.where(inside, row * camera.width + column, -1)
        return local, pixel

    def pixels_per_area(self, local: Points, normals: Points) -> Float64[np.ndarray, " n"]:
        """Returns on how many pixels (1/m^2) a surface is shown: fx fy |n.c| / z^3; 0 from behind."""
        fx, fy = self.view.camera.matrix[[0, 1], [0, 1]]
        facing = -np.einsum("ni,ij,nj->n", normals, self.view.world_from_camera[:3, :3], local)
        return np.asarray(fx * fy * np.maximum(facing, 0) / np.maximum(local[:, 2], NEAR_M) ** 3)


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
        points, normals = mesh.positions.astype(np.float64), mesh.normals.astype(np.float64)
        own = self.frames[index].pixels_per_area(self.frames[index].find(points)[0], normals)
        copied = np.zeros(len(points), bool)
        for number, other in enumerate(self.frames):
            if number == index:
                continue
            local, pixel = other.find(points)
            shown = other.pixels_per_area(local, normals)
            larger = shown >= own if number < index else shown > own
            copied |= larger & covered[number][pixel] & _is_there(other, local, pixel)
        return replace(mesh, triangles=mesh.triangles[~short_axis.all_of(copied[mesh.triangles])])

    def count_showing(self, points: Points) -> Int64[np.ndarray, " n"]:
        """Returns how many frames show a surface at each point."""
        return np.asarray(sum(_is_there(each, *each.find(points)).astype(np.int64) for each in self.frames))

    def in_free_space(self, points: Points) -> Mask:
        """Returns which points lie before what a camera sees: nothing is there."""
        free = np.zeros(len(points), bool)
        for frame in self.frames:
            local, pixel = frame.find(points)
            inverse = frame.surface.inverse_depth.ravel()[pixel]
            free |= (pixel >= 0) & (inverse > 0) & (inverse * local[:, 2] < 1 - SAME_DEPTH)
        return free


def _is_there(frame: PosedSurface, local: Points, pixel: Int64[np.ndarray, " n"]) -> Mask:
    """Returns whether the frame shows a surface at the points."""
    inverse = frame.surface.inverse_depth.ravel()[pixel]
    return np.asarray((pixel >= 0) & (inverse > 0) & (np.abs(inverse * local[:, 2] - 1) < SAME_DEPTH))
