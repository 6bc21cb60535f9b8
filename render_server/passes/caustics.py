"""Caustics: light that smooth virtual surfaces cast on others, as beams traced from the lights' object maps."""

import math
from collections.abc import Sequence

import moderngl

from deltalight.render_server.gpu.clearing import clear_ahead, clear_buffers
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.cones import LowResGrid, reuse_define
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.mesh_buffers import MaterialTable
from deltalight.render_server.passes.object_bvh import ObjectBvh

RAYS = 4  # of each block of a light's object map
# Through transparent objects, of each ray: at glass a third path has less than 0.2 % of the light but at the rim.
PATHS = 2
# Above this GGX alpha a lobe (2 alpha wide) is, at half the objects' extent, wider than such beams: rays then sample
# the lobe, each with a fraction of its energy.
WIDE_ALPHA = 1 / 32
# A lobe with 85 % of its energy within 45 degrees or more is as good as diffuse: voxels carry its light.
GREATEST_ALPHA = 0.174
ROUNDED = 1.001  # of a square, as shaders may compute it
SENT_BEAM_BYTES = 112
BEAMS_A_ROW, BEAM_TEXELS, PLACE_TEXELS = 256, 4, 2  # of the images that hold them (shaders/common/beams.glsl)
TILE = 8  # texels an edge (shaders/common/beam_tiles.glsl)
WORD_BITS = 32
HEADER_BYTES = 16
SEEN = "Camera", "real_surface_position", "real_surface_normal"  # where beams end
SUMS_BYTES = 6 * 4  # per pixel: three channels on its real surface, three on its object


class CausticBeams:
    """Traces beams from the lights' object maps to the objects that they meet, which are the same for all cameras.

    `blocks` per edge of a light's object map each send a beam of rays. With 64 these start a 128th of the objects'
    extent apart, and after a convex object has spread them four- to eightfold they are as far apart as voxels.
    """

    def __init__(self, gpu: GpuContext, *, blocks: int) -> None:
        self._gpu, self._blocks = gpu, blocks
        self.most = 1  # of beams
        self._sent = gpu.ctx.buffer(reserve=HEADER_BYTES + SENT_BEAM_BYTES)
        self._mirror_beams = Kernel(gpu, "caustic_beams", RAY_COUNT=RAYS)
        self._lobe_beams = Kernel(gpu, "caustic_beams", RAY_COUNT=RAYS, WIDE=1)
        self._refracted_beams: Kernel | None = None

    @property
    def bindings(self) -> dict[str, Binding]:
        """The beams."""
        return {"SentBeams": self._sent}

    def trace(
        self,
        lights: LightBuffers,
        objects: ObjectBvh,
        materials: MaterialTable,
        scene: Bindings,
        *,
        bias_m: float,
    ) -> None:
        """Traces the beams that objects of these materials cast, through transparent ones too.

        `bias_m` offsets receivers of real shadows towards the light.
        """
        kernels = [(self._lobe_beams, WIDE_ALPHA, GREATEST_ALPHA)]
        if materials.smoothest**2 < ROUNDED * WIDE_ALPHA:
            kernels.insert(0, (self._mirror_beams, 0.0, WIDE_ALPHA))
        if materials.transmits:
            if self._refracted_beams is None:
                self._refracted_beams = Kernel(
                    self._gpu, "caustic_beams", RAY_COUNT=RAYS, REFRACTED=1, PATHS=PATHS
                )
            kernels.append((self._refracted_beams, 0.0, GREATEST_ALPHA))
        self._empty_beams(len(lights.object_views) * (1 + PATHS if materials.transmits else 1))
        own: Bindings = {**scene, **objects.bindings, "bias_real": bias_m}
        for view in range(len(lights.object_views)):
            self._trace_beams(lights, lights.first_object_view + view, own, kernels)

    def _empty_beams(self, views: int) -> None:
        """Allocates and clears the beams of that many views, each with one beam a ray."""
        self.most = max(views * self._blocks**2 * RAYS, 1)
        needed = HEADER_BYTES + SENT_BEAM_BYTES * self.most
        if self._sent.size < needed:
            self._sent.orphan(needed)
        self._gpu.clear_start(self._sent, HEADER_BYTES)

    def _trace_beams(
        self,
        lights: LightBuffers,
        view_index: int,
        scene: Bindings,
        kernels: Sequence[tuple[Kernel, float, float]],
    ) -> None:
        """Adds the beams of one view, by each kernel those of materials from its least to its greatest alpha."""
        shared: dict[str, Binding] = {
            "view_index": view_index,
            "block_edge": max(lights.tile_size // self._blocks, 1),
            "SentBeams": self._sent,
        }
        for kernel, least, greatest in kernels:
            kernel.run(
                (self._blocks, self._blocks, RAYS), shared, scene, least_alpha=least, greatest_alpha=greatest
            )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._sent, self._mirror_beams, self._lobe_beams, self._refracted_beams)


class Caustics:
    """Renders caustics as fixed-point irradiance on real surfaces and objects (shaders/common/caustic_sums.glsl)."""

    def __init__(self, gpu: GpuContext, grid: LowResGrid, *, reuses: bool = False) -> None:
        self._gpu, self._threads, self._grid = gpu, list_threads(gpu), grid
        size = SUMS_BYTES * (math.prod(grid.picture_size) + math.prod(grid.size))
        lower = "output.width and output.height"
        self._sums = gpu.storage_buffer(size, lower)
        self._last_sums = gpu.storage_buffer(size, lower) if reuses else None
        self._count = gpu.ctx.buffer(reserve=4)
        self._beams: moderngl.Texture | None = None
        self._places: moderngl.Texture | None = None
        self._end = Kernel(gpu, "caustic_ends")
        self._unended: dict[str, Binding] = {}  # what ends beams that were sent and have not ended
        self._unended_threads = 0
        self._empties = not (reuses or gpu.is_software)  # the sums, by the way; in software that is a memset
        own = {"CLEARS": 1} if self._empties else reuse_define(reuses)
        self._find_bounds = Kernel(gpu, "caustic_bounds", **own)
        # One dispatch on a GPU; in software each workgroup would pay for entering the longer kernel.
        self._end_in_bounds = None if gpu.is_software else Kernel(gpu, "caustic_bounds", ENDS=1, **own)
        self._tiles = tuple(-(-edge // TILE) for edge in grid.size)
        self._balls = texture_2d(gpu, (self._tiles[0], 2 * self._tiles[1]), 4, "f4")
        self._tile_beams = gpu.ctx.buffer(reserve=4)
        # One dispatch on a GPU; in software every workgroup would pay for entering the longer kernel.
        both = {} if gpu.is_software else {"NARROW": 1}
        self._find_tiles = Kernel(gpu, "caustic_tiles", WIDE=1, **both)
        self._add_narrow = Kernel(gpu, "caustic_tiles", NARROW=1) if gpu.is_software else None
        rows = 8 if gpu.is_software else 2  # software renderers read a beam once for each of few threads
        self._gather = Kernel(
            gpu, "caustic_gather", ROWS=rows, GROUP_ROWS=TILE // rows, **reuse_define(reuses)
        )

    @property
    def bindings(self) -> dict[str, Binding]:
        """The sums, for passes that shade."""
        return {"CausticSums": self._sums}

    def end_beams(self, sent: CausticBeams, scene: Bindings, reach_m: float) -> None:
        """Ends beams where they meet something within `reach_m`, of the real scene what the `scene`'s camera sees.

        On a GPU, `run` does so.
        """
        self._make_room(sent.most)
        self._gpu.clear_start(self._count, 4)
        self._unended = {**scene, **sent.bindings, "reach": reach_m}
        self._unended_threads = list_threads(self._gpu, sent.most)
        if self._gpu.is_software:
            self._end_apart()

    def _end_apart(self) -> None:
        """Ends the beams by a kernel of its own."""
        own: Bindings = {"BeamCount": self._count, "beam_texels": self._beams}
        self._end.run((self._unended_threads,), self._unended, own)
        self._unended = {}

    def _make_room(self, beams: int) -> None:
        rows = -(-beams // BEAMS_A_ROW)
        if self._beams is None or self._beams.height < rows:
            release_all(self._beams, self._places)
            self._beams = texture_2d(self._gpu, (BEAM_TEXELS * BEAMS_A_ROW, rows), 4, "f4")
            self._places = texture_2d(self._gpu, (PLACE_TEXELS * BEAMS_A_ROW, rows), 4, "i2")
            words = 2 * math.prod(self._tiles) * rows * BEAMS_A_ROW // WORD_BITS
            self._tile_beams.release()
            self._tile_beams = self._gpu.storage_buffer(4 * words, "output.width and output.height")

    def run(self, scene: Bindings) -> None:
        """Fills the sums with the light of the beams where they end."""
        if self._last_sums is not None:
            self._sums, self._last_sums = self._last_sums, self._sums
        sums = [] if self._empties else [(self._sums, self._sums.size)]
        clear_buffers(self._gpu, (self._tile_beams, self._tile_beams.size), *sums)
        grid = self._grid
        shared: Bindings = {
            **self.bindings,
            "BeamCount": self._count,
            "beam_texels": self._beams,
            "beam_places": self._places,
            "sample_pixels": grid.pixels,
            "picture_pixels": grid.picture_size,
            "scale": grid.scale,
        }
        self._add_beams(shared, scene)
        clear_ahead(self._gpu, (self._tile_beams, self._tile_beams.size))
        if self._last_sums is not None:
            clear_ahead(self._gpu, (self._last_sums, self._last_sums.size))

    def _add_beams(self, shared: Bindings, scene: Bindings) -> None:
        """Finds where beams are; adds narrow ones, then wide ones in each tile of the grid that they may reach."""
        assert self._places is not None
        most, (across, down) = self._places.height * BEAMS_A_ROW, self._tiles
        own: Bindings = {
            "tiles": self._tiles,
            "beam_words": most // WORD_BITS,
            "tile_balls": self._balls,
            "TileBeams": self._tile_beams,
        }
        self._find_places(scene, own, shared, self._grid.bindings)
        walkers = list_threads(self._gpu, most)
        if self._add_narrow is None:
            rows = -(-self._threads // walkers)  # of workgroups that add narrow beams
            self._find_tiles.run((walkers, down + rows), own, shared, scene)
        else:
            self._find_tiles.run((walkers, down), own, shared, scene)
            self._add_narrow.run((self._threads,), own, shared, scene)
        self._gather.run((TILE * across, self._gather.local_size[1] * down), own, shared, scene)

    def _find_places(self, scene: Bindings, *shared: Bindings) -> None:
        """Finds the beams' places; and their ends, unless they have ended, or must in what another frame saw."""
        kernel, unended = self._find_bounds, self._unended
        if unended and self._end_in_bounds is not None and all(unended[name] is scene[name] for name in SEEN):
            kernel, self._unended = self._end_in_bounds, {}
        elif unended:
            self._end_apart()
        kernel.run((self._bound_threads(),), *shared, scene, unended, **self._last_bindings())

    def _bound_threads(self) -> int:
        """Returns those of all tiles of both layers, of texels if the last frame's are reused, and of beams."""
        items = [2 * math.prod(self._tiles), 0 if self._last_sums is None else math.prod(self._grid.size)]
        group = self._find_bounds.local_size[0]
        return self._threads + sum(-(-count // group) * group for count in items)

    def _last_bindings(self) -> dict[str, Binding]:
        return {} if self._last_sums is None else {"LastSums": self._last_sums}

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self._sums,
            self._last_sums,
            self._count,
            self._beams,
            self._places,
            self._end,
            self._find_bounds,
            self._end_in_bounds,
            self._balls,
            self._tile_beams,
            self._find_tiles,
            self._add_narrow,
            self._gather,
        )
