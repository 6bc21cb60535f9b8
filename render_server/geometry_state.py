"""Geometry as stages receive it: triangles of the real scene, and of the virtual objects, in GPU buffers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol import short_axis
from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.passes.mesh_buffers import MaterialTable, MeshBuffers
from deltalight.render_server.passes.voxelize import Chosen, VoxelizedMesh
from deltalight.render_server.scene.depth_mesh import BACK_OFFSET_VOXELS
from deltalight.render_server.scene.gpu_mesh import GpuMesh
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import TriangleMesh

Corners = Float32[np.ndarray, "m 3 3"]

# Half the edge of a volume by how far objects reach from its middle, at least. Less than 2 / sqrt(3): twice the edge
# of a cube leaves it that much in any turn.
TURN_CLEARANCE = 1.15


@dataclass(frozen=True, eq=False)
class ObjectExtent:
    """Bounds of virtual objects over all of their animations.

    Attributes:
        points: enclose the objects (world, m).
        upright: least and greatest coordinates, as if each object were turned back about its own middle. What is
            placed by these stands still while objects turn.
        parts: the extent of each object alone.
    """

    points: Float64[np.ndarray, "n 3"]
    upright: Float64[np.ndarray, "2 3"]
    parts: tuple["ObjectExtent", ...] = ()

    @classmethod
    def around(cls, parts: Sequence["ObjectExtent"]) -> "ObjectExtent":
        """Returns the extent of several objects."""
        if len(parts) == 1:
            return cls(parts[0].points, parts[0].upright, tuple(parts))
        points = np.concatenate([each.points for each in parts])
        upright = np.array(short_axis.bounds(np.concatenate([each.upright for each in parts])))
        return cls(points, upright, tuple(parts))

    def equals(self, other: "ObjectExtent") -> bool:
        """Whether both are the same."""
        same = np.array_equal(self.points, other.points) and np.array_equal(self.upright, other.upright)
        parts = zip(self.parts, other.parts, strict=False)
        return same and len(self.parts) == len(other.parts) and all(a.equals(b) for a, b in parts)

    @cached_property
    def bounds(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Least and greatest coordinates of the points, m."""
        return short_axis.bounds(self.points)

    @cached_property
    def middle(self) -> Float64[np.ndarray, "3"]:
        """Middle of `upright`, m."""
        return np.asarray(self.upright.mean(axis=0))

    @cached_property
    def extended_parts(self) -> Sequence["ObjectExtent"]:
        """Those of several parts that are no mere points; none if there is one."""
        return [each for each in self.parts if each.volume_edge > 0] if len(self.parts) > 1 else ()

    @cached_property
    def volume_edge(self) -> float:
        """Edge of a volume around the objects, m: twice the longest edge of `upright` ([P1] 3.2).

        It is larger only where several objects that turn come nearer to the border than a single one can.
        """
        low, high = self.upright
        reach = float(np.abs(self.points - short_axis.mean(self.upright)).max())
        return 2.0 * max(float((high - low).max()), TURN_CLEARANCE * reach)


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """One virtual object: its asset as loaded, and its pose (rotation, uniform scale, translation; m).

    `material` is the scene document's replacement for the asset's own, if any. `moves` marks an object that
    plays an animation: its `meshes` are valid for this frame only.
    """

    id: str
    meshes: tuple[TriangleMesh, ...]
    world_from_asset: Float64[np.ndarray, "4 4"]
    material: Material | None
    moves: bool = False


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh on the GPU, and the same on the CPU; either may be made only when it is needed.

    `filled` are its buffers, or a function that has the GPU fill them; they hold it until another mesh is written
    there. `made` is the mesh that was uploaded, or a function that makes on the CPU what the GPU made of depth.
    `is_behind`: it is the coarse mesh of these buffers, behind the one that is drawn.
    """

    filled: MeshBuffers | Callable[[], MeshBuffers]
    made: GpuMesh | Callable[[], GpuMesh]
    is_behind: bool = False

    @cached_property
    def buffers(self) -> MeshBuffers:
        """Vertices and triangles on the GPU."""
        return self.filled() if callable(self.filled) else self.filled

    @property
    def triangles(self) -> range:
        """Which of the buffers' triangles it has."""
        return self.buffers.coarse if self.is_behind else range(self.buffers.triangle_count)

    @cached_property
    def mesh(self) -> GpuMesh:
        """The triangles on the CPU; may take time."""
        return self.made() if callable(self.made) else self.made

    @cached_property
    def corners(self) -> Corners:
        """Corners of all triangles, m; takes time."""
        return self.mesh.corners


ChooseBacks = Callable[[DrawnMesh, float], Chosen]
"""Returns which triangles of a mesh get back faces, for voxels of that edge (m)."""


@dataclass(frozen=True, eq=False)
class GeometryState:
    """An immutable set of triangles in the world: a new object whenever they change.

    Attributes:
        drawn: the triangles.
        points: enclose the set (world, m).
        materials: what the triangles' material indices refer to.
        coarse: makes a mesh of fewer triangles, for distant voxels; None: `drawn` serves.
        objects: the virtual objects that the triangles belong to; none for the real scene.
        swept_points: enclose the set at all times of its animations, so that what is fitted around them stands still
            while it moves; None: nothing is animated.
        extents: of each virtual object.
        lamps: lights that come with virtual objects (world, camera units).
        is_open: solid things whose backs no camera saw, so that the mesh lacks them.
        choose_backs: excludes back faces where another camera sees empty space; None: all are used.
    """

    drawn: DrawnMesh
    points: Float64[np.ndarray, "n 3"]
    materials: MaterialTable
    coarse: Callable[[], DrawnMesh] | None = None
    objects: tuple[PlacedObject, ...] = ()
    swept_points: Float64[np.ndarray, "k 3"] | None = None
    extents: tuple[ObjectExtent, ...] = ()
    lamps: tuple[Light, ...] = ()
    is_open: bool = False
    choose_backs: ChooseBacks | None = None

    @property
    def is_measured(self) -> bool:
        """Whether it comes from depth cameras: many small triangles, which change with every frame."""
        return self.coarse is not None

    @property
    def buffers(self) -> MeshBuffers:
        """Vertices and triangles on the GPU."""
        return self.drawn.buffers

    def fill(self) -> None:
        """Has the GPU make the triangles if they are made there and are not made yet."""
        assert self.buffers is not None

    @property
    def corners(self) -> Corners:
        """Corners of all triangles, m; takes time."""
        return self.drawn.corners

    @property
    def parts(self) -> tuple[VoxelizedMesh, ...]:
        """All triangles, for the voxeliser."""
        return (VoxelizedMesh(self.buffers),)

    @cached_property
    def coarse_mesh(self) -> DrawnMesh:
        """The same with fewer triangles; made on first use."""
        return self.drawn if self.coarse is None else self.coarse()

    @property
    def coarse_parts(self) -> tuple[VoxelizedMesh, ...]:
        """Fewer triangles, for distant voxels."""
        return (VoxelizedMesh(self.coarse_mesh.buffers, triangles=self.coarse_mesh.triangles),)

    def solid_parts(self, voxel_edge: float) -> tuple[VoxelizedMesh, ...]:
        """Returns `parts` for voxels of that edge (m), with coarse back faces if cameras saw only the fronts.

        There is none where another camera sees empty space behind a thing thinner than two voxels.
        """
        if not self.is_open:
            return self.parts
        coarse = self.coarse_mesh
        chosen = None if self.choose_backs is None else self.choose_backs(coarse, voxel_edge)
        behind_m = BACK_OFFSET_VOXELS * voxel_edge
        return *self.parts, VoxelizedMesh(coarse.buffers, behind_m, chosen, coarse.triangles)

    @cached_property
    def bounds(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Least and greatest coordinates, m."""
        return short_axis.bounds(self.points)

    @cached_property
    def triangle_boxes(self) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]:
        """Least and greatest coordinates of each triangle, m."""
        return short_axis.boxes(self.corners.astype(np.float64))

    @cached_property
    def triangle_edges(self) -> Float64[np.ndarray, " m"]:
        """Longest edge of each triangle's box, m."""
        low, high = self.triangle_boxes
        return short_axis.greatest(high - low)

    @property
    def lasting_points(self) -> Float64[np.ndarray, "k 3"]:
        """Points that enclose the set at all times of its animations."""
        return self.points if self.swept_points is None else self.swept_points

    @property
    def extent(self) -> ObjectExtent:
        """Bounds of the set over all of its animations."""
        if self.extents:
            return ObjectExtent.around(self.extents)
        return ObjectExtent(self.lasting_points, np.stack(short_axis.bounds(self.lasting_points)))
