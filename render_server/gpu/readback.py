"""Asynchronous readback: a ring of pixel buffers, so that reading a picture does not stall the GPU."""

from collections import deque
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext

RING = 3


class AsyncReadback:
    """Copies textures into pixel buffers immediately and returns their bytes later, oldest first."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._free: list[moderngl.Buffer] = []
        self._waiting: deque[tuple[moderngl.Buffer, tuple[int, int, int], np.dtype[Any]]] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, texture: moderngl.Texture, dtype: str) -> None:
        """Starts copying `texture` (level 0, as `dtype` elements)."""
        width, height = texture.size
        shape = (height, width, texture.components)
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        buffer = self._take(size)
        texture.read_into(buffer, alignment=1)
        self._waiting.append((buffer, shape, np.dtype(dtype)))

    def pop(self) -> np.ndarray[Any, Any]:
        """Returns the oldest pushed texture (h, w, components); waits only if the GPU has not finished it."""
        buffer, shape, dtype = self._waiting.popleft()
        size = int(np.prod(shape)) * dtype.itemsize
        array = np.frombuffer(buffer.read(size), dtype=dtype).reshape(shape)
        self._free.append(buffer)
        return array

    def _take(self, size: int) -> moderngl.Buffer:
        """Returns an idle buffer of `size` bytes."""
        for index, buffer in enumerate(self._free):
            if buffer.size == size:
                return self._free.pop(index)
        while len(self._free) >= RING:
            self._free.pop(0).release()
        return self._ctx.buffer(reserve=size, dynamic=True)

    def release(self) -> None:
        """Frees all buffers."""
        for buffer in [*self._free, *(entry[0] for entry in self._waiting)]:
            buffer.release()
        self._free.clear()
        self._waiting.clear()
