"""A context whose new memory holds NaN: OpenGL promises nothing of it, while Mesa clears it."""

from typing import Any

import moderngl
import numpy as np

POISON = b"\xff"  # NaN in floats, -1 or the greatest number in integers
MOST_BYTES = 2**30


class FilledContext:
    """Fills new buffers and textures of a context that are given no content; `filled` counts them.

    `unfilled` is that context.
    """

    def __init__(self, ctx: moderngl.Context, content: bytes = POISON) -> None:
        self.unfilled, self._content, self.filled = ctx, content, 0

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self.unfilled, name)

    def buffer(
        self, data: bytes | None = None, *, reserve: int = 0, dynamic: bool = False
    ) -> moderngl.Buffer:
        if reserve > MOST_BYTES:  # no device has it, nor this process
            return self.unfilled.buffer(data, reserve=reserve, dynamic=dynamic)
        self.filled += data is None
        return self.unfilled.buffer(self._content * reserve if data is None else data, dynamic=dynamic)

    def _filled(self, kind: str, data: bytes | None, args: tuple[Any, ...], more: dict[str, Any]) -> Any:  # noqa: ANN401
        texture = getattr(self.unfilled, kind)(*args, data, **more)
        if data is None:
            self.filled += 1
            size, components = args
            unit = more.get("alignment", 1)
            row = -(-components * int(texture.dtype[-1]) * size[0] // unit) * unit
            texture.write(self._content * (row * int(np.prod(size[1:]))), alignment=unit)
        return texture

    def texture(self, *args: Any, data: bytes | None = None, **more: Any) -> Any:  # noqa: ANN401
        return self._filled("texture", *_split(args, data), more)

    def texture3d(self, *args: Any, data: bytes | None = None, **more: Any) -> Any:  # noqa: ANN401
        return self._filled("texture3d", *_split(args, data), more)

    def texture_array(self, *args: Any, data: bytes | None = None, **more: Any) -> Any:  # noqa: ANN401
        return self._filled("texture_array", *_split(args, data), more)


def _split(args: tuple[Any, ...], data: bytes | None) -> tuple[bytes | None, tuple[Any, ...]]:
    """Content, and (size, components)."""
    return (args[2] if len(args) > 2 else data), args[:2]
