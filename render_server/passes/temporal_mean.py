"""The camera's picture averaged over time where nothing moves, for passes that noise would make flicker."""

from typing import Final

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.scene.motion_detection import MotionThresholds
from deltalight.render_server.view import Rectangle

BLOCK: Final = 8  # pixels an edge: so many show a shift by a fraction of a pixel despite their noise
LONGEST = 16  # pictures: noise falls to a quarter, still more than half floats round off


class TemporalMean:
    """Running mean of the linear picture. Blocks that change by more than noise, and those around, start anew.

    So the mean differs from the newest picture by less than that picture's noise.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._size = size
        self._mean = texture_2d(gpu, size, 4, "f2")
        self._changed = texture_2d(gpu, (-(-size[0] // BLOCK), -(-size[1] // BLOCK)), 1, "u1")
        self._find_changes = Kernel(gpu, "changed_blocks", BLOCK=BLOCK)
        self._average = Kernel(gpu, "temporal_mean", BLOCK=BLOCK)

    def add(self, linear_picture: Binding, rectangle: Rectangle) -> Binding:
        """Adds a picture (RGBA16F); returns the mean, which holds what `rectangle` shows."""
        x, y, width, height = rectangle
        left, top = x // BLOCK, y // BLOCK
        right, bottom = -(-(x + width) // BLOCK), -(-(y + height) // BLOCK)
        blocks, limits = (left, top, right - left, bottom - top), MotionThresholds()
        self._find_changes.run(
            blocks[2:],
            linear_picture=linear_picture,
            temporal_mean=self._mean,
            changed_out=self._changed,
            blocks=blocks,
            noise=limits.color_noise,
            sigmas=limits.color_sigmas,
        )
        self._average.run(
            (BLOCK * blocks[2], BLOCK * blocks[3]),
            linear_picture=linear_picture,
            changed=self._changed,
            mean=self._mean,
            blocks=blocks,
            longest=LONGEST,
        )
        return self._mean

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._mean, self._changed, self._find_changes, self._average)
