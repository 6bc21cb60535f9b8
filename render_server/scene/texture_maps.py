"""Textures of materials: how they lie on a surface, and their pictures in asset files (docs/materials.md)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float16, Float32, Shaped, UInt8
from PIL import Image

from deltalight.protocol.frames import decode_lut
from deltalight.render_server.scene.gltf_document import GltfDocument, GltfFaultError

MAX_TEXTURE_PIXELS = 64_000_000
MAX_FILE_PIXELS = 512_000_000  # of all pictures of a file that are decoded
MAX_TEXTURE_EDGE = 1024  # texels that are kept of a picture's longer edge
MAP_BYTES = 512 << 20  # of all texels of one kind, mip levels left out; beyond, textures lose resolution
_DECODED_ROWS = 1 << 20  # pixels that are made linear at a time


class Wrap(IntEnum):
    """What is beyond a texture's edge."""

    REPEAT = 0
    CLAMP = 1
    MIRROR = 2


_WRAPS = {10497: Wrap.REPEAT, 33071: Wrap.CLAMP, 33648: Wrap.MIRROR}
_NEAREST = 9728


@dataclass(frozen=True, eq=False)
class TextureMap:
    """A texture and how it lies on a surface (glTF 2.0, sections 3.8.2 and 5.29; KHR_texture_transform).

    `texels`: linear R G B or R G B A of a colour (float16), or R G B of data (bytes); row 0 is the top, uv (0, 0) its
    top-left corner. `from_uv` maps (u, v, 1) of the vertices' set `uv_set` to the texture's own coordinates.
    `strength` scales a normal's tilt, or weighs occlusion.
    """

    texels: Shaped[np.ndarray, "h w c"]
    uv_set: int = 0
    from_uv: Float32[np.ndarray, "2 3"] = field(default_factory=lambda: np.eye(2, 3, dtype=np.float32))
    wraps: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    is_nearest: bool = False
    strength: float = 1.0

    @property
    def is_color(self) -> bool:
        """Whether it holds colours, not data."""
        return self.texels.dtype == np.float16

    def nearest(self, uv: Float32[np.ndarray, "*n 2"]) -> Float32[np.ndarray, "*n c"]:
        """Returns the nearest texels at the vertices' coordinates."""
        place = uv @ self.from_uv[:, :2].T + self.from_uv[:, 2]
        size = self.texels.shape[1::-1]
        column, row = (
            np.clip((_wrapped(place[..., axis], wrap) * size[axis]).astype(int), 0, size[axis] - 1)
            for axis, wrap in enumerate(self.wraps)
        )
        return np.asarray(self.texels[row, column], np.float32)


def _wrapped(x: Float32[np.ndarray, "*n"], wrap: Wrap) -> Float32[np.ndarray, "*n"]:
    if wrap == Wrap.REPEAT:
        return np.asarray(x % 1)
    return np.asarray(np.clip(x, 0, 1) if wrap == Wrap.CLAMP else 1 - np.abs(x % 2 - 1))


def linear_texture(image: Image.Image, *, with_alpha: bool = False) -> Float16[np.ndarray, "h w c"]:
    """Decodes an sRGB picture to linear R G B [A], of at most MAX_TEXTURE_EDGE texels an edge.

    Raises:
        ValueError: it has more than 64 million pixels or cannot be decoded.
    """
    decode = decode_lut(None)[:, 0]
    codes = _codes(image, "RGBA" if with_alpha else "RGB")

    def linear(part: UInt8[np.ndarray, "h w c"]) -> Float32[np.ndarray, "h w c"]:
        values: Float32[np.ndarray, "h w c"] = decode[part]
        values[..., 3:] = part[..., 3:] / np.float32(255)
        return values

    return np.asarray(_reduced(codes, linear), np.float16)


def data_texture(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    """Decodes a picture of numbers to bytes R G B, of at most MAX_TEXTURE_EDGE texels an edge.

    Raises:
        ValueError: as `linear_texture`.
    """
    mean = _reduced(_codes(image, "RGB"), lambda part: part.astype(np.float32))
    return np.asarray(np.round(mean), np.uint8)


def _codes(image: Image.Image, mode: str) -> UInt8[np.ndarray, "h w c"]:
    if image.width * image.height > MAX_TEXTURE_PIXELS:
        raise ValueError(f"a texture of {image.width}x{image.height} pixels is too large")
    try:
        if image.mode == "P":  # whose transparency the loader warns of when it is converted to anything else
            image = image.convert("RGBA")
        return np.asarray(image.convert(mode))
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"a texture cannot be decoded: {error}") from error


def _reduced(
    codes: UInt8[np.ndarray, "h w c"], linear: Callable[[np.ndarray], Float32[np.ndarray, "h w c"]]
) -> Float32[np.ndarray, "k l c"]:
    """Averages the `linear` values of a large picture; first by whole pixels, some rows at a time."""
    height, width, channels = codes.shape
    by = max(1, max(height, width) // MAX_TEXTURE_EDGE)
    by = min(by, height, width)
    rows = max(1, _DECODED_ROWS // (by * width))
    parts = []
    for first in range(0, height // by, rows):
        part = codes[first * by : min(first + rows, height // by) * by, : width // by * by]
        blocks = linear(part).reshape(-1, by, width // by, by, channels)
        parts.append(blocks.mean(axis=(1, 3)) if by > 1 else blocks[:, 0, :, 0])
    values = np.concatenate(parts)
    scale = MAX_TEXTURE_EDGE / max(values.shape[:2])
    if scale >= 1:
        return values
    size = max(1, round(values.shape[1] * scale)), max(1, round(values.shape[0] * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA)).reshape(*size[::-1], channels)


class TextureReader:
    """Decodes the pictures of a glTF document, each once for a use; their pixels are counted."""

    def __init__(self, gltf: GltfDocument) -> None:
        self._gltf = gltf
        self._pixels = 0
        self._decoded: dict[tuple[int, str], Shaped[np.ndarray, "h w c"] | None] = {}

    def color(self, info: dict[str, Any] | None, *, with_alpha: bool = False) -> TextureMap | None:
        """Returns the map that a `textureInfo` describes, of colours; None if there is none that can be read.

        Raises:
            GltfFaultError: its picture is damaged or too large, or its place on the surface unknown.
        """
        kind = "color and alpha" if with_alpha else "color"
        return self._map(info, kind, lambda image: linear_texture(image, with_alpha=with_alpha))

    def data(self, info: dict[str, Any] | None, strength: str = "") -> TextureMap | None:
        """Returns the map that a `textureInfo` describes, of data; `strength` is the key of its weight.

        Raises:
            GltfFaultError: as `color`.
        """
        found = self._map(info, "data", data_texture)
        if found is None or info is None:
            return found
        weight = float(info.get(strength, 1.0))
        if not math.isfinite(weight):
            raise GltfFaultError(f"a texture has the {strength} {weight}")
        return replace(found, strength=weight)

    def _map(
        self,
        info: dict[str, Any] | None,
        kind: str,
        decode: Callable[[Image.Image], Shaped[np.ndarray, "h w c"]],
    ) -> TextureMap | None:
        if info is None:
            return None
        texels = self._texels(info["index"], kind, decode)
        if texels is None:
            return None
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        uv_set = transform.get("texCoord", info.get("texCoord", 0))
        if uv_set not in (0, 1):
            raise GltfFaultError(f"a texture lies on texture coordinates {uv_set}, and only 0 and 1 are read")
        sampler = self._gltf.sampler(info["index"])
        wraps = tuple(_WRAPS[sampler.get(key, 10497)] for key in ("wrapS", "wrapT"))
        is_nearest = sampler.get("magFilter") == _NEAREST
        return TextureMap(texels, uv_set, _uv_matrix(transform), (wraps[0], wraps[1]), is_nearest)

    def _texels(
        self, texture: int, kind: str, decode: Callable[[Image.Image], Shaped[np.ndarray, "h w c"]]
    ) -> Shaped[np.ndarray, "h w c"] | None:
        source = self._gltf.image_of(texture)
        if source is None:
            return None
        key = source, kind
        if key not in self._decoded:
            image = self._gltf.image(source)
            self._pixels += image.width * image.height
            if self._pixels > MAX_FILE_PIXELS:
                raise GltfFaultError(f"its textures have more than {MAX_FILE_PIXELS // 10**6} million pixels")
            try:
                self._decoded[key] = decode(image)
            except ValueError as error:
                raise GltfFaultError(f"image {source}: {error}") from error
        return self._decoded[key]


def _uv_matrix(transform: dict[str, Any]) -> Float32[np.ndarray, "2 3"]:
    """Returns offset * rotation * scale of KHR_texture_transform.

    Rotation is counter-clockwise where v points down, as the extension says in words and all viewers have it; its
    GLSL sample turns the other way (KhronosGroup/glTF issue 1563).
    """
    x, y = transform.get("scale", (1.0, 1.0))
    cosine, sine = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    u, v = transform.get("offset", (0.0, 0.0))
    matrix = np.array([[cosine * x, sine * y, u], [-sine * x, cosine * y, v]], np.float32)
    if not np.isfinite(matrix).all():
        raise GltfFaultError("a KHR_texture_transform is not finite")
    return matrix


def map_edge(maps: Sequence[TextureMap], texel_bytes: int) -> int:
    """Returns the edge of the layers that hold the maps, texels."""
    longest = max((max(each.texels.shape[:2]) for each in maps), default=1)
    edge = min(1 << (longest - 1).bit_length(), MAX_TEXTURE_EDGE)
    while len(maps) * edge * edge * texel_bytes > MAP_BYTES:
        edge //= 2
    return edge


def resampled(each: TextureMap, size: int) -> Shaped[np.ndarray, "n n 4"]:
    """Returns a map's texels at size x size: averaged over areas, or interpolated, unless it is unfiltered."""
    texels = each.texels.astype(np.float32)
    grows = size > min(texels.shape[:2])
    enlarging = cv2.INTER_NEAREST if each.is_nearest else cv2.INTER_LINEAR
    resized = cv2.resize(texels, (size, size), interpolation=enlarging if grows else cv2.INTER_AREA)
    rgba = np.full((size, size, 4), 1.0 if each.is_color else 255.0, np.float32)
    rgba[..., : texels.shape[2]] = resized.reshape(size, size, -1)
    return rgba.astype(np.float16) if each.is_color else np.round(rgba).astype(np.uint8)
