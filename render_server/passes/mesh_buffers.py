"""Meshes on the GPU: vertices and triangles, and materials with their textures."""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float32

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.texel_rows import TexelRows
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.scene.gpu_mesh import VERTEX_ATTRIBUTES, VERTEX_LAYOUT, GpuMesh
from deltalight.render_server.scene.material_tables import coating_table, map_table, measured_table
from deltalight.render_server.scene.texture_maps import TextureMap, map_edge, resampled
from deltalight.render_server.scene.triangle_mesh import padded

# Of the vertices of meshes that have either, in a buffer of their own.
PLACEMENT_LAYOUT, PLACEMENT_ATTRIBUTES = "2f 4f", ("in_second_uv", "in_tangent")
METALLIC, REFLECTANCE, ROUGHNESS, DOUBLE_SIDED, BY_LIGHT = (
    3,
    slice(4, 7),
    7,
    12,
    14,
)  # columns of the material table, as materials.glsl has them

BASE_MAPS, ALL_MAPS = 5, 13  # of a material, as materials.glsl has them
LEAST_EDGE = 2
"""Of an array of maps, texels: one without mip levels makes Mesa's llvmpipe compile all kernels with maps anew."""

NO_CUTOUTS: Bindings = {"CUTOUTS": False}
NO_COARSE = range(0)
VERTEX_BYTES, TRIANGLE_BYTES = 48, 12  # of a row of VERTEX_LAYOUT, and of three indices
CORNERS_ROW = 1024  # triangles in a row of their corners' texels


class MeshBuffers:
    """Vertex and index buffers that are rewritten when the mesh changes.

    `cutouts` binds what tells where the mesh is not there (`MaterialTable`).
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu, self._ctx = gpu, gpu.ctx
        self._vertices = gpu.ctx.buffer(reserve=4)
        self._indices = gpu.ctx.buffer(reserve=4)
        self._sides = gpu.ctx.buffer(reserve=4)
        self._held: GpuMesh | None = None  # what the first two hold, unless a kernel wrote it
        self._held_sides = b""
        self._placement: moderngl.Buffer | None = None
        self._corners = TexelRows(gpu, 3 * CORNERS_ROW, "f4")
        self._shown: GpuMesh | None = None  # whose corners these are
        self._arrays: dict[int, moderngl.VertexArray] = {}
        self.triangle_count = 0  # of those that are drawn, with any without area
        self.coarse = NO_COARSE  # triangles behind these, of a coarser mesh, which are not drawn
        self.cutouts = NO_CUTOUTS

    @property
    def storage(self) -> dict[str, Binding]:
        """Vertices (rows of `VERTEX_LAYOUT`), for shaders that trace rays."""
        return {"Vertices": self._vertices}

    @property
    def solid(self) -> dict[str, Binding]:
        """Vertices, triangles, and the sides of each material (`DOUBLE_SIDED`), for passes that walk triangles."""
        return {
            "Vertices": self._vertices,
            "Indices": self._indices,
            "Sides": self._sides,
            "MapPlacement": self._placement,
        }

    @property
    def corners(self) -> dict[str, Binding]:
        """What common/plane.glsl reads beside `solid`, of a mesh that was written: in software, its corners."""
        return {"mesh_corners": self._corner_texture()} if self._gpu.is_software else {}

    def _corner_texture(self) -> moderngl.Texture:
        """Returns the positions of the triangles' corners."""
        mesh = self._held
        assert mesh is not None
        self._corners.reserve(3 * len(mesh.triangles))
        for part in mesh.parts_beside(self._shown):
            texels = self._corners.renewed(3 * part.first_triangle, 3 * len(part.triangles))
            # In its default mode, "raise", NumPy would gather into a copy first.
            padded(part.vertices[:, :3]).take(part.triangles.ravel(), axis=0, out=texels, mode="clip")
        self._shown = mesh
        return self._corners.texture

    def write(self, mesh: GpuMesh) -> None:
        """Replaces the contents by those of `mesh`; parts that they have already are not written again."""
        self._reserve(mesh.vertex_count, len(mesh.triangles), mesh)
        for part in mesh.parts_beside(self._held):
            self._vertices.write(part.vertices, offset=VERTEX_BYTES * part.first_vertex)
        if self._held is None or mesh.triangles is not self._held.triangles:
            self._indices.write(mesh.triangles)
        self._held = mesh
        self._write_placement(mesh.placement)

    def reserve(
        self, vertex_count: int, triangle_count: int, materials: GpuMesh, coarse: range = NO_COARSE
    ) -> None:
        """Makes room for triangles of the materials of a mesh, which a kernel is to write (`solid`).

        `coarse`: those of a coarser mesh, if there is one, behind the `triangle_count` that are drawn.
        """
        self._held = None
        self._reserve(vertex_count, triangle_count, materials, coarse)

    def _reserve(
        self, vertex_count: int, triangle_count: int, materials: GpuMesh, coarse: range = NO_COARSE
    ) -> None:
        vertex_bytes = vertex_count * VERTEX_BYTES
        index_bytes = (triangle_count + len(coarse)) * TRIANGLE_BYTES
        if vertex_bytes > self._vertices.size or index_bytes > self._indices.size:
            self._release_buffers()
            self._vertices = self._ctx.buffer(reserve=max(vertex_bytes, 4))
            self._indices = self._ctx.buffer(reserve=max(index_bytes, 4))
            self._sides = self._ctx.buffer(reserve=4)
            self._held, self._held_sides = None, b""
        self.triangle_count, self.coarse = triangle_count, coarse
        if triangle_count:
            self._write_sides(materials.material_table[:, DOUBLE_SIDED])

    def _write_sides(self, double_sided: Float32[np.ndarray, " k"]) -> None:
        sides = double_sided.tobytes()
        if self._sides.size != len(sides):
            self._sides.orphan(len(sides))
        elif sides == self._held_sides:
            return
        self._sides.write(sides)
        self._held_sides = sides

    def _write_placement(self, rows: Float32[np.ndarray, "n 6"] | None) -> None:
        if rows is None and self._placement is None:
            return
        release_all(*self._arrays.values(), self._placement)
        self._arrays.clear()
        self._placement = None if rows is None else self._ctx.buffer(np.ascontiguousarray(rows, np.float32))

    def draw(self, program: moderngl.Program) -> None:
        """Draws all triangles with `program`."""
        if not self.triangle_count:
            return
        if program.glo not in self._arrays:
            layout: list[tuple[Any, ...]] = [
                (self._vertices, *_layout_of(program, VERTEX_LAYOUT, VERTEX_ATTRIBUTES))
            ]
            if self._placement is not None:
                form, *names = _layout_of(program, PLACEMENT_LAYOUT, PLACEMENT_ATTRIBUTES)
                layout += [(self._placement, form, *names)] if names else []
            self._arrays[program.glo] = self._ctx.vertex_array(program, layout, self._indices)
        self._arrays[program.glo].render(moderngl.TRIANGLES, vertices=3 * self.triangle_count)

    def release(self) -> None:
        """Frees all buffers."""
        self._release_buffers()
        self._corners.release()

    def _release_buffers(self) -> None:
        release_all(*self._arrays.values(), self._vertices, self._indices, self._sides)
        release_all(self._placement)
        self._arrays.clear()
        self._placement = None


def _layout_of(program: moderngl.Program, layout: str, names: Sequence[str]) -> tuple[str, ...]:
    """Returns format and attributes of a vertex; attributes that the compiler removed become padding."""
    parts = list(zip(layout.split(), names, strict=True))
    active = {name for _, name in parts if program.get(name, None) is not None}
    formats = (part if name in active else f"{int(part[0]) * 4}x" for part, name in parts)
    return " ".join(formats), *(name for _, name in parts if name in active)


class MaterialTable:
    """Materials in a storage buffer; if any has maps or alpha, their textures in two arrays (common/materials.glsl).

    `smoothest` is the least roughness of those that reflect specularly, 1 if none does, `smoothest_coat` that of what
    lies over them; `transmits` tells whether light passes through any. `draws_maps`: false for the
    real scene, of which the camera tells how it looks.
    """

    def __init__(self, gpu: GpuContext, mesh: GpuMesh, *, draws_maps: bool = True) -> None:
        maps = [
            each
            for material in mesh.materials
            for each in (*material.maps, *material.maps_by_light)
            if each is not None
        ]
        self._has_cutouts = draws_maps and any(material.alpha_mode for material in mesh.materials)
        self._hides_backs = draws_maps and any(material.hides_back for material in mesh.materials)
        self._has_maps = draws_maps and (self._has_cutouts or bool(maps))
        self.smoothest = _smoothest(mesh)
        self.smoothest_coat = _smoothest_coat(mesh)
        self._is_extended = draws_maps and any(material.is_extended for material in mesh.materials)
        self.transmits = any(material.transmits for material in mesh.materials)
        self._colors = self._data = None
        table = mesh.material_table
        if self._is_extended:
            table = np.hstack([table, coating_table(mesh.materials)])
        if self._has_maps:
            self._colors = MapArray(gpu, [each for each in maps if each.is_color], "f2")
            self._data = MapArray(gpu, [each for each in maps if not each.is_color], "f1")
            count = ALL_MAPS if self._is_extended else BASE_MAPS
            table = np.hstack([table, map_table(mesh.materials, mesh.repeats_per_m(), self._layer, count)])
            for row, material in zip(table, mesh.materials, strict=True):
                if material.maps_by_light:
                    row[BY_LIGHT] = 1 + self._layer(material.maps_by_light[0])
        self._buffer = gpu.ctx.buffer(np.ascontiguousarray(table, np.float32).tobytes())
        self._transmittances = gpu.ctx.buffer(_transmittances(mesh).tobytes()) if self.transmits else None
        self._measured = _measured_texture(gpu, mesh)

    def _layer(self, each: TextureMap) -> int:
        array = self._colors if each.is_color else self._data
        assert array is not None
        return array.layer(each)

    @property
    def bindings(self) -> dict[str, Binding]:
        """Table and textures by GLSL name, and which of their features are used."""
        return {
            "Materials": self._buffer,
            "color_maps": None if self._colors is None else self._colors.texture,
            "data_maps": None if self._data is None else self._data.texture,
            "MATERIAL_MAPS": self._has_maps,
            "CUTOUTS": self._has_cutouts,
            "HIDES_BACKS": self._hides_backs,
            "EXTENDED": self._is_extended,
            "PACKS_EXTENDED": self._is_extended and self._has_maps,
            "TRANSMISSION": self.transmits,
            "Transmittances": self._transmittances,
            "MEASURED": self._measured is not None,
            "measured_brdfs": self._measured,
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._buffer, self._transmittances, self._measured, self._colors, self._data)


class MapArray:
    """Textures of one kind as layers of one array, with mip levels; each texture once.

    All layers have the size of the largest texture, a power of 2, less if they would take too much
    (`map_edge`), but at least LEAST_EDGE: without textures, too.
    """

    def __init__(self, gpu: GpuContext, maps: Sequence[TextureMap], dtype: str) -> None:
        unique = {(id(each.texels), each.is_nearest): each for each in maps}
        self._layers = {key: layer for layer, key in enumerate(unique)}
        limit = int(gpu.ctx.info["GL_MAX_ARRAY_TEXTURE_LAYERS"])
        if len(unique) > limit:
            raise DeltalightError(
                f"the objects have {len(unique)} textures of one kind, and this GPU takes {limit}: use fewer."
            )
        size = max(map_edge(list(unique.values()), 4 * int(dtype[1])), LEAST_EDGE)
        self.texture = gpu.ctx.texture_array((size, size, max(len(unique), 1)), 4, dtype=dtype)
        for layer, each in enumerate(unique.values()):
            data = resampled(each, size)
            self.texture.write(data.tobytes(), viewport=(0, 0, layer, size, size, 1))
        self.texture.build_mipmaps()
        self.texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def layer(self, each: TextureMap) -> int:
        """Returns the layer of one of the maps."""
        return self._layers[id(each.texels), each.is_nearest]

    def release(self) -> None:
        """Frees the texture."""
        self.texture.release()


def _measured_texture(gpu: GpuContext, mesh: GpuMesh) -> moderngl.Texture | None:
    """Returns the table of measured materials; None if there are none."""
    table = measured_table(mesh.materials)
    if any(material.by_light is not None for material in mesh.materials) and not len(table):
        table = np.zeros((1, *table.shape[1:]), np.float32)  # an image cannot be without texels
    if not len(table):
        return None
    texture = texture_2d(gpu, (table.shape[1], len(table)), 4, "f4")
    texture.write(table.tobytes())
    return texture


def _transmittances(mesh: GpuMesh) -> Float32[np.ndarray, "k 4"]:
    """Returns what each material lets through of light in its shadow, and its alpha (common/tinted_shadows.glsl)."""
    rows = np.zeros((len(mesh.materials), 4), np.float32)
    for index, material in enumerate(mesh.materials):
        if material.transmits:
            rows[index] = *material.mean_transmittance(mesh.mean_path_m(index)), material.roughness**2
    return rows


def _smoothest(mesh: GpuMesh) -> float:
    table = mesh.material_table
    reflects = (table[:, METALLIC] > 0) | (table[:, REFLECTANCE] > 0).any(axis=1)
    reflects |= np.array([material.transmits for material in mesh.materials])
    darkest = np.array([_least_green(material.metallic_roughness_map) for material in mesh.materials])
    return float(min((table[:, ROUGHNESS] * darkest)[reflects], default=1.0))


def _smoothest_coat(mesh: GpuMesh) -> float:
    coats = [material for material in mesh.materials if material.coat > 0]
    return min((each.coat_roughness * _least_green(each.coat_roughness_map) for each in coats), default=1.0)


def _least_green(each: TextureMap | None) -> float:
    return 1.0 if each is None else float(each.texels[..., 1].min()) / 255
