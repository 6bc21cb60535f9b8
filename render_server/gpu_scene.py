"""Triangles on the GPU as stages receive them: those of the real scene and of the virtual objects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol import short_axis
from deltalight.render_server.lights.lights import Light
from deltalight.render_server.passes.mesh_buffers import MaterialTable, MeshBuffers
from deltalight.render_server.passes.voxelize import Chosen, VoxelizedMesh
from deltalight.render_server.scene.depth_mesh import BACK_OFFSET_VOXELS
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import GpuMesh, TriangleMesh

Corners = Float32[np.ndarray, "m 3 3"]

# Half the edge of a volume by how far objects reach from its middle, at least. Less than 2 / sqrt(3): twice the edge
# of a cube leaves it that much in any turn.
TURN_CLEARANCE = 1.15


@dataclass(frozen=True, eq=False)
class ObjectExtent:
    """Where virtual objects are throughout their animations.

    `points` enclose them (world, m). `upright` holds the least and greatest coordinates as if every object was turned
    back about its own middle: what is placed by them stands still while objects turn. `parts`: each object alone.
    """

    points: Float64[np.ndarray, "n 3"]
    upright: Float64[np.ndarray, "2 3"]
    parts: tuple["ObjectExtent", ...] = ()

    @classmethod
    def around(cls, parts: Sequence["ObjectExtent"]) -> "ObjectExtent":
        """Returns the extent of several objects."""
        points = np.concatenate([each.points for each in parts])
        upright = np.stack(short_axis.bounds(np.concatenate([each.upright for each in parts])))
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

    @property
    def volume_edge(self) -> float:
        """Edge of a volume around, m: twice the longest edge of `upright` ([P1] 3.2).

        More only where several objects, turned, would come nearer to its border than one alone can.
        """
        reach = float(np.abs(self.points - self.upright.mean(axis=0)).max())
        return 2.0 * max(float(np.ptp(self.upright, axis=0).max()), TURN_CLEARANCE * reach)


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
    """Triangles in buffers, until others are written there.

    `filled` are the buffers, or has the GPU fill them. `made` is what was uploaded or, for triangles that the GPU
    made of depth, makes the same on the CPU.
    """

    filled: MeshBuffers | Callable[[], MeshBuffers]
    made: GpuMesh | Callable[[], GpuMesh]

    @cached_property
    def buffers(self) -> MeshBuffers:
        """Vertices and triangles on the GPU."""
        return self.filled() if callable(self.filled) else self.filled

    @cached_property
    def mesh(self) -> GpuMesh:
        """The triangles on the CPU; may take time."""
        return self.made() if callable(self.made) else self.made

    @cached_property
    def corners(self) -> Corners:
        """Corners of all triangles, m; takes time."""
        return self.mesh.corners


ChooseBacks = Callable[[DrawnMesh, float], Chosen]
"""Returns which triangles of a mesh have backs in voxels of an edge (m)."""


@dataclass(frozen=True, eq=False)
class GeometryState:
    """One set of triangles in the world; another set is another object.

    `points` enclose the set.
    `swept_points` enclose it at all times of its animations: what is fitted around them stands still while it moves.
    """

    drawn: DrawnMesh
    points: Float64[np.ndarray, "n 3"]
    materials: MaterialTable
    coarse: Callable[[], DrawnMesh] | None = None  # makes fewer triangles for what lies far; None: all serve
    objects: tuple[PlacedObject, ...] = ()  # what the triangles of virtual geometry were made from
    swept_points: Float64[np.ndarray, "k 3"] | None = None  # None: nothing is animated
    extents: tuple[ObjectExtent, ...] = ()  # of each virtual object
    lamps: tuple[Light, ...] = ()  # that come with virtual objects; world, camera units
    is_open: bool = False  # what is solid as cameras see it: backs are not in it
    choose_backs: ChooseBacks | None = None  # by several cameras, which tell where backs cannot be

    @property
    def is_measured(self) -> bool:
        """Whether cameras saw it, so that there are many small triangles, and others with every frame."""
        return self.coarse is not None

    @property
    def buffers(self) -> MeshBuffers:
        """Vertices and triangles on the GPU."""
        return self.drawn.buffers

    def fill(self) -> None:
        """Has the GPU make the triangles, once, if it makes them."""
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
        """Fewer triangles; made when first asked for."""
        return self.drawn if self.coarse is None else self.coarse()

    @property
    def coarse_parts(self) -> tuple[VoxelizedMesh, ...]:
        """Fewer triangles, for what lies far."""
        return (VoxelizedMesh(self.coarse_mesh.buffers),)

    def solid_parts(self, voxel_edge: float) -> tuple[VoxelizedMesh, ...]:
        """Returns `parts` for voxels of that edge (m), with coarse backs if cameras saw the fronts alone.

        What is thinner than two voxels has none where another camera sees that nothing is there.
        """
        if not self.is_open:
            return self.parts
        coarse = self.coarse_mesh
        chosen = None if self.choose_backs is None else self.choose_backs(coarse, voxel_edge)
        return *self.parts, VoxelizedMesh(coarse.buffers, BACK_OFFSET_VOXELS * voxel_edge, chosen)

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
        """Where the set is throughout its animations, and as its objects turn."""
        if self.extents:
            return ObjectExtent.around(self.extents)
        return ObjectExtent(self.lasting_points, np.stack(short_axis.bounds(self.lasting_points)))
