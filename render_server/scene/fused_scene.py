"""The fused real scene: choice of voxels, and when its triangles are made anew."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64

from render_server.scene.depth_surface import DepthSurface
from render_server.scene.fused_align import aligned_view
from render_server.scene.mesh_loading import TriangleMesh
from render_server.scene.tsdf_mesh import decimated, fused_mesh
from render_server.scene.tsdf_volume import BLOCK, GRID, FusedPlacement, FusedVolume, PixelPlanes
from render_server.view import CameraView

# What lies farther than so many median distances goes to a second, coarser volume: a far wall would else spend the
# voxels that near things need.
NEAR_MEDIANS = 2.0
# Triangles of the near and the far volume at their own fineness, before they are thinned to a budget: averaging a
# frame in and making triangles anew takes a core 30 ms each at 320x240.
FINE_TRIANGLES = (80_000, 20_000)
# A surface of area A crosses A (|nx| + |ny| + |nz|) / h^2 edges of the lattice, 1.5 A / h^2 in the mean over
# directions; each gives two triangles.
TRIANGLES_PER_CELL = 3.0
# Memory for four times the blocks that the first frame fills (measured: a block for 54 triangles), 36 MB for the near
# volume; what would go beyond is left out.
TRIANGLES_PER_BLOCK = 54 / 4
# Share of a box's edge that the first frame fills: the camera will look elsewhere.
FIRST_SHARE = 0.5
# Triangles are made anew when this share of the voxels at surfaces moved by more than this share of a voxel: less
# hardly changes how much of a voxel of the volume they cover.
MOVED_SHARE, MOVED_VOXELS = 0.02, 0.25


class FusedScene:
    """Two volumes that are laid out for the first frame, and their triangles."""

    def __init__(self) -> None:
        self.volumes: list[FusedVolume] = []
        self._meshed: list[Float32[np.ndarray, "b 512"]] = []
        self._meshes: list[TriangleMesh] = []
        self.view: CameraView | None = None
        """From where the last frame's depth fits the surface."""

    @property
    def voxel_m(self) -> float:
        """Distance of the near volume's voxels, m; 0 before anything was seen."""
        return self.volumes[0].placement.voxel_m if self.volumes else 0.0

    def add(
        self,
        surface: DepthSurface,
        view: CameraView,
        noise_sigma: float,
        *,
        align: bool = False,
        settle: bool = False,
    ) -> bool:
        """Average a frame into the volumes; returns whether the triangles are new.

        Args:
            surface: of the frame's depth; one without any known pixel changes nothing.
            view: camera and pose of the frame.
            noise_sigma: depth noise at 1 m, m.
            align: the pose has an error that is worth correcting by the shape seen (a marker board's).
            settle: make the triangles anew however little changed.
        """
        self.view = view
        if not (surface.inverse_depth > 0).any():
            return False
        if not self.volumes:
            self.volumes = [FusedVolume(place) for place in placements(surface, view, noise_sigma)]
            self._meshed = [volume.known_distance() for volume in self.volumes]
        if align:
            self.view = aligned_view(self.volumes, surface, view, noise_sigma)
        planes = PixelPlanes.of(surface, view.camera, noise_sigma)
        for volume in self.volumes:
            volume.integrate(planes, self.view)
        if not settle and self._moved_share() <= MOVED_SHARE:
            return False
        self._meshed = [volume.known_distance() for volume in self.volumes]
        self._meshes = [fused_mesh(volume) for volume in self.volumes]
        return True

    def meshes(self, *triangle_budgets: int) -> list[list[TriangleMesh]]:
        """Near and far surfaces in at most so many triangles, for each budget (falling); none before a frame."""
        meshes, result = self._meshes, []
        for budget in triangle_budgets:
            share = min(1.0, budget / max(sum(len(mesh.triangles) for mesh in meshes), 1))
            meshes = [decimated(mesh, int(share * len(mesh.triangles))) for mesh in meshes]
            result.append(meshes)
        return result

    def _moved_share(self) -> float:
        """Share of the voxels at surfaces whose distance differs from the one that triangles were made of."""
        pairs = zip(self.volumes, self._meshed, strict=True)
        counts = np.array([_count_moved(volume, meshed) for volume, meshed in pairs]).sum(axis=0)
        return float(counts[0] / max(counts[1], 1))


def _count_moved(volume: FusedVolume, meshed: Float32[np.ndarray, "b 512"]) -> tuple[int, int]:
    """Count voxels at surfaces that moved, and voxels at surfaces."""
    now, voxel_m = volume.known_distance(), volume.placement.voxel_m
    before = np.full_like(now, np.nan)
    before[: len(meshed)] = meshed
    at_surface: Bool[np.ndarray, "b 512"] = (np.abs(now) < voxel_m) | (np.abs(before) < voxel_m)
    moved = at_surface & ~(np.abs(now - before) <= MOVED_VOXELS * voxel_m)
    return int(np.count_nonzero(moved)), int(np.count_nonzero(at_surface))


class _Shown(NamedTuple):
    """What each known pixel of a frame shows: place (world), distance along the axis, area (m, m^2)."""

    points: Float64[np.ndarray, "n 3"]
    z: Float64[np.ndarray, " n"]
    area: Float64[np.ndarray, " n"]

    def only(self, chosen: Bool[np.ndarray, " n"]) -> "_Shown":
        return _Shown(*(values[chosen] for values in self))


def placements(
    surface: DepthSurface, view: CameraView, noise_sigma: float
) -> tuple[FusedPlacement, FusedPlacement]:
    """A cube around what one frame shows near by, and a coarser one around all of it."""
    shown = _shown(surface, view)
    near = shown.z <= NEAR_MEDIANS * np.median(shown.z)
    details_1m = noise_sigma, 1 / float(view.camera.matrix[0, 0])
    inside = _placement(shown.only(near), shown.only(near), details_1m, FINE_TRIANGLES[0])
    beyond = shown if near.all() else shown.only(~near)
    around = _placement(shown, beyond, details_1m, FINE_TRIANGLES[1])
    return inside, replace(around, hole=inside.box)


def _placement(
    held: _Shown, counted: _Shown, details_1m: tuple[float, float], triangles: int
) -> FusedPlacement:
    """A cube around what is `held`, with voxels so small that what is `counted` gives so many triangles.

    Voxels are no smaller than the noise of one frame or a pixel's footprint (`details_1m`: at 1 m) at the median
    distance, which hold no more detail; and so large that the cube leaves room around what it holds.
    """
    low, high = np.percentile(held.points, [1, 99], axis=0)
    edge_m = float((high - low).max()) / FIRST_SHARE
    noise, pixel = details_1m
    distance = float(np.median(counted.z))
    by_budget = float(np.sqrt(TRIANGLES_PER_CELL * counted.area.sum() / triangles))
    voxel_m = max(by_budget, noise * distance**2, pixel * distance, edge_m / (GRID * BLOCK))
    blocks = min(int(np.ceil(edge_m / (BLOCK * voxel_m))), GRID)
    x, y, z = (float(v) for v in (low + high) / 2 - voxel_m * blocks * BLOCK / 2)
    return FusedPlacement((x, y, z), voxel_m, blocks, int(triangles / TRIANGLES_PER_BLOCK))


def _shown(surface: DepthSurface, view: CameraView) -> _Shown:
    """A pixel shows z^2 / f^2 / cos(slant), at most 80 degrees aslant."""
    known = surface.inverse_depth > 0
    z = 1 / surface.inverse_depth[known].astype(np.float64)
    towards = np.dstack([view.camera.rays(), np.ones(known.shape, np.float32)])[known].astype(np.float64)
    cosine = np.abs(np.einsum("ni,ni->n", towards, surface.normals[known])) / np.linalg.norm(towards, axis=1)
    cosine = np.where(cosine > 0, cosine, 1)  # no normal: as if it faced the camera
    matrix, focal = view.world_from_camera, view.camera.matrix
    area = z * z / (focal[0, 0] * focal[1, 1]) / np.maximum(cosine, np.cos(np.radians(80)))
    return _Shown(towards * z[:, None] @ matrix[:3, :3].T + matrix[:3, 3], z, area)
