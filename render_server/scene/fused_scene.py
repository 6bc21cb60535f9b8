"""The fused real scene: choice of voxels, and when its triangles are made anew."""

import numpy as np
from jaxtyping import Bool, Float32, Float64

from render_server.scene.depth_surface import DepthSurface
from render_server.scene.fused_align import aligned_view
from render_server.scene.fused_mesh import decimated, fused_mesh
from render_server.scene.fused_volume import BLOCK, GRID, FusedPlacement, FusedVolume
from render_server.scene.mesh import TriangleMesh
from render_server.view import CameraView

# What lies farther than so many median distances goes to a second, coarser volume: a far wall would else spend the
# voxels that near things need.
NEAR_MEDIANS = 2.0
# Triangles of the near and the far volume at their own fineness, before they are thinned to a budget: averaging a frame
# in and making triangles anew takes one core of 2020 about 30 ms each.
FINE_TRIANGLES = (80_000, 20_000)
# A surface of area A crosses A (|nx| + |ny| + |nz|) / h^2 edges of the lattice, 1.5 A / h^2 in the mean over directions;
# each gives two triangles.
TRIANGLES_PER_CELL = 3.0
# Memory for four times the blocks that the first frame fills (measured: a block for 54 triangles), 25 MB for the near
# volume; what would go beyond is left out.
TRIANGLES_PER_BLOCK = 54 / 4
# Share of a box's edge that the first frame fills: the camera will look elsewhere.
FIRST_SHARE = 0.5
# Triangles are made anew when this share of the voxels at surfaces moved by more than this share of a voxel: less
# hardly changes how much of a voxel of the volume they cover.
MOVED_SHARE, MOVED_VOXELS = 0.01, 0.25


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

    def add(self, surface: DepthSurface, view: CameraView, noise_sigma: float, *, settle: bool = False) -> bool:
        """Average a frame into the volumes; returns whether the triangles are new.

        Args:
            surface: of the frame's depth; one without any known pixel changes nothing.
            view: camera and pose of the frame, by the board.
            noise_sigma: depth noise at 1 m, m.
            settle: make the triangles anew however little changed.
        """
        self.view = view
        if not (surface.inverse_depth > 0).any():
            return False
        if not self.volumes:
            self.volumes = [FusedVolume(place) for place in placements(surface, view, noise_sigma)]
            self._meshed = [volume.known_distance() for volume in self.volumes]
        self.view = aligned_view(self.volumes, surface, view, noise_sigma)
        for volume in self.volumes:
            volume.integrate(surface, self.view, noise_sigma)
        if not settle and self._moved_share() <= MOVED_SHARE:
            return False
        self._meshed = [volume.known_distance() for volume in self.volumes]
        self._meshes = [fused_mesh(volume) for volume in self.volumes]
        return True

    def meshes(self, triangle_budget: int) -> list[TriangleMesh]:
        """Near and far surfaces in at most so many triangles; empty before anything was seen."""
        total = sum(len(mesh.triangles) for mesh in self._meshes)
        share = min(1.0, triangle_budget / max(total, 1))
        return [
            decimated(mesh, int(share * len(mesh.triangles)), volume.placement.voxel_m)
            for mesh, volume in zip(self._meshes, self.volumes, strict=True)
        ]

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


def placements(
    surface: DepthSurface, view: CameraView, noise_sigma: float
) -> tuple[FusedPlacement, FusedPlacement]:
    """A cube around what one frame shows near by, and a coarser one around all of it."""
    z = 1 / surface.inverse_depth[surface.inverse_depth > 0].astype(np.float64)
    near = z <= NEAR_MEDIANS * np.median(z)
    inside = _placement(surface, view, noise_sigma, near, FINE_TRIANGLES[0])
    around = _placement(surface, view, noise_sigma, np.ones_like(near), FINE_TRIANGLES[1], near)
    return inside, FusedPlacement(around.origin, around.voxel_m, around.blocks, around.max_blocks, inside.box)


def _placement(
    surface: DepthSurface,
    view: CameraView,
    noise_sigma: float,
    held: Bool[np.ndarray, " n"],
    triangles: int,
    elsewhere: Bool[np.ndarray, " n"] | None = None,
) -> FusedPlacement:
    """A cube around the known pixels that are `held`, with voxels so small that they give so many triangles.

    Pixels that are held `elsewhere` give none. Voxels are no smaller than the noise of one frame or a pixel's footprint
    at the median distance, which hold no more detail; and so large that the cube leaves room around what it holds.
    """
    points, area = _points_and_areas(surface, view)
    counted = held if elsewhere is None or elsewhere.all() else held & ~elsewhere
    low, high = np.percentile(points[held], [1, 99], axis=0)
    centre = (low + high) / 2
    edge_m = float((high - low).max()) / FIRST_SHARE
    middle = float(np.median(1 / surface.inverse_depth[surface.inverse_depth > 0][counted]))
    voxel_m = max(
        float(np.sqrt(TRIANGLES_PER_CELL * area[counted].sum() / triangles)),
        noise_sigma * middle**2,
        middle / float(view.camera.matrix[0, 0]),
        edge_m / (GRID * BLOCK),
    )
    blocks = min(int(np.ceil(edge_m / (BLOCK * voxel_m))), GRID)
    x, y, z = (float(v) for v in centre - voxel_m * blocks * BLOCK / 2)
    return FusedPlacement((x, y, z), voxel_m, blocks, int(triangles / TRIANGLES_PER_BLOCK))


def _points_and_areas(
    surface: DepthSurface, view: CameraView
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """World position and area (m^2) of what each known pixel shows: z^2 / f^2 / cos(slant), at most 80 degrees."""
    known = surface.inverse_depth > 0
    z = 1 / surface.inverse_depth[known].astype(np.float64)
    towards = np.dstack([view.camera.rays(), np.ones(known.shape, np.float32)])[known].astype(np.float64)
    cosine = np.abs(np.einsum("ni,ni->n", towards, surface.normals[known])) / np.linalg.norm(towards, axis=1)
    cosine = np.where(cosine > 0, cosine, 1)  # no normal: as if it faced the camera
    matrix, focal = view.world_from_camera, view.camera.matrix
    area = z * z / (focal[0, 0] * focal[1, 1]) / np.maximum(cosine, np.cos(np.radians(80)))
    return towards * z[:, None] @ matrix[:3, :3].T + matrix[:3, 3], area
