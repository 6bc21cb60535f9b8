"""Change of light beyond the objects' volumes, found on a sparse lattice."""

from collections.abc import Mapping

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.shading import DirectLight

LATTICE_STEP = 4  # texels of the reduced grid from one point of the lattice to the next
AIMED_CONES = 16  # of a point of the lattice, at each volume


class DistantChange:
    """Relative change of the light at real surfaces beyond the volumes (docs/method.md 4.5).

    `ChangeRatio` interpolates the lattice (shaders/common/distant_change.glsl). `size` is that of the reduced grid,
    `defines` are those of march.glsl.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], defines: Mapping[str, int]) -> None:
        self._points = (-(-size[0] // LATTICE_STEP), -(-size[1] // LATTICE_STEP))
        self._lattice = texture_2d(gpu, self._points, 4, "f2")
        self._pixels = texture_2d(gpu, self._points, 4, "i2")
        own = {"REAL": 1, "LATTICE_STEP": LATTICE_STEP, "ENDS_AHEAD": 1, "AIMED_CONES": AIMED_CONES}
        self._find = Kernel(gpu, "distant_change", **own, **defines)

    def trace(
        self, scene: Bindings, grid: LowResGrid, direct: DirectLight, cones: ConeFields, marching: Bindings
    ) -> dict[str, Binding]:
        """Aims cones at the volumes from surfaces beyond them; returns what shaders read of the lattice."""
        self._find.run(
            self._points,
            grid.bindings,
            scene,
            marching,
            direct_mu=direct.light.mu,
            cone_mu=cones.mu,
            cone_rho=cones.rho,
            lattice_change=self._lattice,
            lattice_pixels=self._pixels,
        )
        return {**scene, "lattice_change": self._lattice, "lattice_pixels": self._pixels}

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._lattice, self._pixels, self._find)
