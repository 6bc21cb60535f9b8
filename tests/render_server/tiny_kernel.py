"""A kernel of a few statements that writes floats, for tests of what binds to kernels."""

from collections.abc import Callable
from dataclasses import dataclass

import moderngl
import numpy as np

from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.uniform_block import Block, Float, Vec4

OUT = "layout(std430) buffer Out { float values[]; };\n"
MakeKernel = Callable[..., Kernel]


@dataclass(frozen=True, eq=False)
class CameraBlock(Block):
    pinhole: Vec4
    z: Float


def floats(buffer: moderngl.Buffer, count: int) -> list[float]:
    return [float(value) for value in np.frombuffer(buffer.read(4 * count), np.float32)]
