"""Pixel coverage of the virtual objects, and antialiasing and unmixing of the edges around it."""

import math
from collections.abc import Sequence

import moderngl
import numpy as np
from jaxtyping import Float, Float64

from deltalight.render_server.gpu.clearing import Start, clear_ahead, clear_buffers
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import (
    GROUPS_BYTES,
    LIST_HEADER_BYTES,
    MOST_WALKERS,
    list_threads,
)
from deltalight.render_server.gpu.picture_kernel import PictureKernel
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.passes.gbuffer import GeometryBuffer, RasterGeometry
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.view import NEAR_M, CameraView, Rectangle, union

# Sample positions in 1/16 pixels from the pixel's centre, nearest first. The first, where surfaces are shaded, is the
# centre: anywhere else would shift what objects show against the picture. Of all such patterns of eight with one
# sample in each column and row of eighths (an upright edge is exact to 1/16) this one has the least worst-case error
# for an edge at any angle and position: 0.18 of a pixel, 0.055 r.m.s.
PATTERN = ((0, 0), (5, -3), (-3, 5), (-7, 1), (-5, -5), (1, -7), (3, 7), (7, 3))
STEPS = 16
# Of shaders/common/raster_tiles.glsl: texels an edge of a tile, tiles an edge of one of the next level.
TILE, MOST_TILES, LEVELS = 2, 16, 4
EDGE_GROUP = 64  # threads of a workgroup of shaders/edge_samples.comp.glsl
TILE_BYTES = NODE_BYTES = NODES_HEADER_BYTES = 8
# Room for lists: small triangles meet two to four tiles each, large ones as many as there are in layers. Where it
# does not suffice, edges are not antialiased.
NODES_PER_TRIANGLE, NODES_PER_TILE = 4, 12
RIM_SIGHT = 6
"""Pixels within which an edge pixel finds both the real thing and the background unmixed.

Behind the two pixels that may be mixed there are four more on either side.
"""
SURFACE_REACH = 22
"""Pixels within which the surface that represents a mixed pixel may lie: half floats hold so many offsets exactly."""


class EdgeTriangles:
    """The triangles of a mesh that may show in marked tiles of a raster, in a list for each tile."""

    def __init__(self, gpu: GpuContext, raster: tuple[int, int]) -> None:
        self._gpu, self._raster = gpu, raster
        edges = [TILE * MOST_TILES**level for level in range(LEVELS)]
        counts = [math.prod(-(-side // edge) for side in raster) for edge in edges]
        self._starts = tuple(sum(counts[:level]) for level in range(LEVELS))
        self._least_nodes = NODES_PER_TILE * counts[0]
        self.tiles = gpu.ctx.buffer(reserve=TILE_BYTES * sum(counts))
        self.nodes = gpu.ctx.buffer(reserve=NODES_HEADER_BYTES)
        self.groups = gpu.ctx.buffer(reserve=GROUPS_BYTES)
        self._thin = Kernel(gpu, "edge_triangles", FIND_THIN=1)
        self._listed = Kernel(gpu, "edge_triangles")

    @property
    def bindings(self) -> dict[str, Binding]:
        """The tiles, for what marks and reads them."""
        return {"Tiles": self.tiles, "raster_size": self._raster, "level_starts": self._starts}

    @property
    def lists(self) -> dict[str, Binding]:
        """The tiles and their lists."""
        return {**self.bindings, "EdgeNodes": self.nodes}

    def clear(self, pixels: moderngl.Buffer) -> None:
        """Marks no tile, and empties all lists, that of `pixels` too."""
        clear_buffers(self._gpu, *self._scratch(pixels))

    def used_up(self, pixels: moderngl.Buffer) -> None:
        """Lets that be cleared ahead: nobody reads marks, lists and `pixels` any more."""
        clear_ahead(self._gpu, *self._scratch(pixels))

    def _scratch(self, pixels: moderngl.Buffer) -> tuple[Start, ...]:
        return (self.tiles, self.tiles.size), (self.nodes, NODES_HEADER_BYTES), (pixels, LIST_HEADER_BYTES)

    def find_thin(self, mesh: MeshBuffers, view: CameraView, raster: GeometryBuffer, scene: Bindings) -> None:
        """Marks the tiles with triangles of `mesh` that may lie between the samples that `raster` has."""
        self._run(self._thin, mesh, view, scene, {**self.bindings, **raster.bindings})

    def list_triangles(
        self, mesh: MeshBuffers, view: CameraView, pixels: moderngl.Buffer, scene: Bindings
    ) -> None:
        """Lists the triangles of `mesh` that may show in tiles that are marked.

        `groups` then are the workgroups of edge_samples that walk the list `pixels`, EDGE_GROUP of them each.
        """
        nodes = self._least_nodes + NODES_PER_TRIANGLE * mesh.triangle_count
        size = NODES_HEADER_BYTES + NODE_BYTES * nodes
        if self.nodes.size < size:
            self.nodes.orphan(size)
            self._gpu.clear_start(self.nodes, NODES_HEADER_BYTES)
        own: Bindings = {**self.lists, "Texels": pixels, "Groups": self.groups, "per_group": EDGE_GROUP}
        self._run(self._listed, mesh, view, scene, own)

    def _run(
        self, kernel: Kernel, mesh: MeshBuffers, view: CameraView, scene: Bindings, own: Bindings
    ) -> None:
        kernel.run(
            (min(mesh.triangle_count, MOST_WALKERS),),
            scene,
            own,
            mesh.solid,
            mesh.corners,
            clip_from_world=view.clip_from_world,
            triangle_count=mesh.triangle_count,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.tiles, self.nodes, self.groups, self._thin, self._listed)


class SampleCoverage:
    """Draws the objects' first sample of each pixel, and finds the others where they may differ.

    A raster has the first one; the rays of the others meet the triangles at the objects' edges. `surface` is the
    geometry buffer on the picture's grid; `texture` (RGBA16F) holds the fraction in front of the real surface, the
    fraction behind it, and that fraction times its mean depth; `second_surface` (RGBA32F) the position and fraction
    of samples that show another surface than `surface`; `pixels` lists those with more than one sample.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], raster: tuple[int, int]) -> None:
        self._gpu = gpu
        self.surface = GeometryBuffer(gpu, size)
        self.texture = texture_2d(gpu, size, 4, "f2")
        self.second_surface = texture_2d(gpu, size, 4, "f4")
        self._filled: Rectangle = (0, 0, *size)  # what may hold anything
        self.pixels = gpu.ctx.buffer(reserve=LIST_HEADER_BYTES + 4 * math.prod(size))
        self.triangles = EdgeTriangles(gpu, raster)
        self._first = PictureKernel(gpu, "sample_coverage")
        self._further = Kernel(
            gpu, "edge_samples", SAMPLES=len(PATTERN), OFFSETS_PX=_as_glsl(PATTERN), NEAR=NEAR_M
        )

    def run(
        self,
        geometry: RasterGeometry,
        raster: GeometryBuffer,
        mesh: MeshBuffers,
        *,
        view: CameraView,
        rectangles: tuple[Rectangle, Rectangle],
        scene: Bindings,
    ) -> None:
        """Fills the textures in the first of the `rectangles` (picture, raster).

        `scene` brings the camera of `view`, which looks at `raster` through the lens: not `with_antialiasing`.
        """
        in_picture, in_raster = rectangles
        touched = union(self._filled, in_picture)  # what was filled before is emptied
        self._filled = in_picture
        self.triangles.clear(self.pixels)
        geometry.run(raster, mesh, view, scene, rectangle=in_raster)
        if scene["PACKS_EXTENDED"]:
            self.surface.with_extended()
        if mesh.triangle_count:
            self.triangles.find_thin(mesh, view, raster, scene)
        self._first.run(
            touched,
            raster.bindings,
            scene,
            self._written,
            self.triangles.bindings,
            rectangle=touched,
            raster_rectangle=in_raster,
            weight=1.0 / len(PATTERN),
        )
        if mesh.triangle_count:
            self._add_samples(mesh, view, scene)
        self.triangles.used_up(self.pixels)

    def _add_samples(self, mesh: MeshBuffers, view: CameraView, scene: Bindings) -> None:
        """Adds the further samples of the pixels that are listed."""
        self.triangles.list_triangles(mesh, view, self.pixels, scene)
        self._further.run_counted(
            self.triangles.groups,
            scene,
            mesh.solid,
            self._written,
            self.triangles.lists,
            mesh.corners,
        )

    @property
    def _written(self) -> dict[str, Binding]:
        return {
            "position_out": self.surface.position,
            "normal_out": self.surface.normal,
            "uv_out": self.surface.uv,
            "tint_out": self.surface.tint,
            "extended_out": self.surface.extended,
            "sample_coverage": self.texture,
            "second_surface": self.second_surface,
            "Texels": self.pixels,
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.surface, self.texture, self.second_surface, self.pixels, self.triangles)
        release_all(self._first, self._further)


def _as_glsl(pattern: Sequence[tuple[int, int]]) -> str:
    """Returns the offsets of samples as an array of pixels."""
    offsets = ", ".join(f"vec2({x / STEPS}, {y / STEPS})" for x, y in pattern)
    return f"vec2[]({offsets})"


class ObjectCoverage:
    """How objects share pixels with real things, and with each other.

    `texture` (R16F) is the fraction of each pixel that shows an object. Pixels at the edge of a real thing before one
    are unmixed: their coverage is corrected by the fraction that the thing fills, and `edge_correction` (RGBA16F)
    removes the old background from their radiance, and says which pixel shows the thing's surface. `interior_edges`
    (RG16F, of pixels that show an object): where samples show two surfaces of the objects, the share of the second
    one and the neighbour that shows it (shaders/common/interior_edges.glsl).
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._gpu, self._threads = gpu, list_threads(gpu)
        self.texture, self.edge_correction = texture_2d(gpu, size, 1, "f2"), texture_2d(gpu, size, 4, "f2")
        self.interior_edges = texture_2d(gpu, size, 2, "f2", data=bytes(4 * math.prod(size)))
        self._targets = [gpu.ctx.framebuffer([each]) for each in (self.texture, self.edge_correction)]
        reach = {"RIM_SIGHT": RIM_SIGHT, "SURFACE_REACH": SURFACE_REACH}
        # One dispatch on a GPU; in software every workgroup would pay for entering the longer kernel.
        self._compare = Kernel(gpu, "object_coverage", **({} if gpu.is_software else {"UNMIXES": 1, **reach}))
        self._unmix = Kernel(gpu, "edge_unmixing", **reach) if gpu.is_software else None
        self._edges = gpu.ctx.buffer(bytes(4 * (1 + math.prod(size)))) if gpu.is_software else None

    def run(self, rectangle: Rectangle, scene: Bindings, samples: SampleCoverage | None = None) -> None:
        """Compares depths within `rectangle`; coverage is softened along edges of the picture, and unmixed.

        `samples`: those of each pixel; None: the geometry buffer has one.
        """
        for target in self._targets:
            target.use()
            target.clear()
        x, y, width, height = rectangle
        if width <= 0 or height <= 0:
            return
        own: Bindings = {
            **scene,
            "sample_coverage": None if samples is None else samples.texture,
            "second_surface": None if samples is None else samples.second_surface,
            "antialiased": samples is not None,
            "object_coverage": self.texture,
            "edge_correction": self.edge_correction,
        }
        if self._edges is not None:
            self._gpu.clear_start(self._edges, LIST_HEADER_BYTES)
            own = {**own, "Texels": self._edges}
        self._compare.run((width, height), own, first_pixel=(x, y), interior_edges=self.interior_edges)
        if self._unmix is not None:
            self._unmix.run((self._threads,), own)

    def release(self) -> None:
        """Frees the GL objects."""
        for target in self._targets:
            release_target(target)
        release_all(self.texture, self.edge_correction, self.interior_edges)
        release_all(self._compare, self._unmix, self._edges)


def mixed_radiance(
    radiance: Float[np.ndarray, "h w 3"], interior_edges: Float[np.ndarray, "h w 2"]
) -> Float64[np.ndarray, "h w 3"]:
    """Mixes the objects' shaded radiance at edges between them, as shaders/common/interior_edges.glsl does.

    `interior_edges` as of `ObjectCoverage`.
    """
    height, width = radiance.shape[:2]
    share, code = interior_edges[..., :1], interior_edges[..., 1].astype(int)
    row = np.clip(np.arange(height)[:, None] + (code >> 2) - 1, 0, height - 1)
    column = np.clip(np.arange(width) + (code & 3) - 1, 0, width - 1)
    return np.asarray(radiance + share * (radiance[row, column] - radiance), np.float64)
