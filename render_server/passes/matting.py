"""Soft mattes of real things in front of objects: hair and the like, found by colour where depth does not show it."""

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, Kernel
from deltalight.render_server.gpu.list_groups import LIST_HEADER_BYTES, list_threads
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.coverage import SURFACE_REACH, ObjectCoverage
from deltalight.render_server.passes.temporal_mean import TemporalMean
from deltalight.render_server.view import Rectangle

BLOCK = 4  # pixels an edge, at which nearest depths are kept
# Length of rays per pixel of reach: between spread fingers the nearest certain background lies beyond the hand.
SIGHT_PER_REACH = 8


class Matting:
    """Finds by colour which fraction of a pixel real things fill, within reach of their edges by depth.

    Corrects the coverage and the unmixing of edges, which stay as they are where colours do not tell. `averages`:
    where nothing moves, colours are means over the last pictures, so that mattes flicker less.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], *, averages: bool = False) -> None:
        self._gpu, self._threads = gpu, list_threads(gpu)
        blocks = -(-size[0] // BLOCK), -(-size[1] // BLOCK)
        self._size = size
        self._nearest, self._within_reach = (texture_2d(gpu, blocks, 4, "f4") for _ in range(2))
        self._band = gpu.ctx.buffer(bytes(4 * (1 + size[0] * size[1])))
        self._nearest_kernel = Kernel(gpu, "nearest_depth")
        self._band_kernel = Kernel(gpu, "matting_band", BLOCK=BLOCK)
        self._estimate, self._contrast = (texture_2d(gpu, size, 4, "f2") for _ in range(2))
        self._kernel = Kernel(gpu, "matting", BLOCK=BLOCK, SURFACE_REACH=SURFACE_REACH)
        self._fusion = Kernel(gpu, "matte_fusion", SURFACE_REACH=SURFACE_REACH)
        self._mean = TemporalMean(gpu, size) if averages else None

    def run(
        self,
        coverage: ObjectCoverage,
        reach_px: int,
        *,
        rectangle: Rectangle,
        scene: Bindings,
        sample_coverage: moderngl.Texture | None,
    ) -> None:
        """Corrects what `coverage` holds of the pixels of `rectangle`, which encloses the objects.

        `reach_px` is rounded up to whole blocks; `sample_coverage` is the texture of `SampleCoverage`.
        """
        self._gpu.clear_start(self._band, LIST_HEADER_BYTES)
        if rectangle[2] <= 0 or rectangle[3] <= 0:
            return
        sight = SIGHT_PER_REACH * reach_px
        scene = self._averaged(scene, self._rectangle_around(rectangle, sight))
        self._find_nearest(scene, rectangle, sight, -(-reach_px // BLOCK))
        own: Bindings = {"sample_coverage": sample_coverage, "antialiased": sample_coverage is not None}
        self._list_band(scene, own, rectangle)
        self._estimate_mattes(scene, own, sight)
        self._fuse(scene, own, rectangle, coverage)

    def _averaged(self, scene: Bindings, met: Rectangle) -> Bindings:
        """Returns the bindings with the mean over the last pictures, where there is one, in what rays meet."""
        if self._mean is None:
            return scene
        return {**scene, "linear_picture": self._mean.add(scene["linear_picture"], met)}

    def _find_nearest(self, scene: Bindings, rectangle: Rectangle, sight: int, reach: int) -> None:
        """Keeps the least depth within `reach` blocks of each block that rays from the rectangle meet."""
        for source, margin, stride, window, target in (
            (scene["real_surface_position"], sight + reach * BLOCK, BLOCK, (0, BLOCK), self._nearest),
            (self._nearest, sight, 1, (-reach, 2 * reach + 1), self._within_reach),
        ):
            blocks = self._blocks_around(rectangle, margin)
            self._nearest_kernel.run(
                blocks[2:], source=source, blocks=blocks, stride=stride, window=window, nearest_out=target
            )

    def _list_band(self, scene: Bindings, own: Bindings, rectangle: Rectangle) -> None:
        """Lists the pixels of objects whose matte is unknown."""
        self._band_kernel.run(
            rectangle[2:],
            scene,
            own,
            rectangle=rectangle,
            nearest_depth=self._within_reach,
            estimate_out=self._estimate,
            Texels=self._band,
        )

    def _estimate_mattes(self, scene: Bindings, own: Bindings, sight: int) -> None:
        """Estimates which fraction of each listed pixel real things fill, by colours along rays of `sight` pixels."""
        self._kernel.run(
            (self._threads,),
            scene,
            own,
            nearest_depth=self._within_reach,
            estimate_out=self._estimate,
            contrast_out=self._contrast,
            Texels=self._band,
            sight=float(sight),
        )

    def _fuse(self, scene: Bindings, own: Bindings, rectangle: Rectangle, coverage: ObjectCoverage) -> None:
        """Averages the estimates of pixels that look alike, and corrects coverage and unmixing by them."""
        self._fusion.run(
            (self._threads,),
            scene,
            own,
            rectangle=rectangle,
            estimate=self._estimate,
            contrast=self._contrast,
            object_coverage=coverage.texture,
            edge_correction=coverage.edge_correction,
            Texels=self._band,
        )

    def _blocks_around(self, rectangle: Rectangle, margin: int) -> Rectangle:
        """Returns the blocks within `margin` pixels of a rectangle of pixels."""
        x, y, width, height = self._rectangle_around(rectangle, margin)
        left, top = x // BLOCK, y // BLOCK
        return left, top, -(-(x + width) // BLOCK) - left, -(-(y + height) // BLOCK) - top

    def _rectangle_around(self, rectangle: Rectangle, margin: int) -> Rectangle:
        """Returns the pixels of the picture within `margin` pixels of a rectangle."""
        x, y, width, height = rectangle
        left, top = max(x - margin, 0), max(y - margin, 0)
        right, bottom = min(x + width + margin, self._size[0]), min(y + height + margin, self._size[1])
        return left, top, right - left, bottom - top

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self._nearest,
            self._within_reach,
            self._band,
            self._nearest_kernel,
            self._estimate,
            self._contrast,
            self._band_kernel,
            self._kernel,
            self._fusion,
            self._mean,
        )
