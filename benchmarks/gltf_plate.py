"""A glTF file of one plate: what a material's textures and vertices show on it is known."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from deltalight.benchmarks.glb_builder import GlbBuilder


class Plate:
    """A rectangle about the origin that faces +z, `width` by `height` m, with one material and its textures.

    Texture coordinates run from its left upper corner (-x, +y) to the right lower one, `repeats` times each way.
    """

    def __init__(self, width: float, height: float, *, repeats: float = 1.0, mirrored: bool = False) -> None:
        self.glb = GlbBuilder()
        x, y = width / 2, height / 2
        corners = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)]
        uv = repeats * np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float)
        if mirrored:
            uv[:, 0] = repeats - uv[:, 0]
        self.half_width, self.half_height = x, y
        self.attributes = {
            "POSITION": self.glb.floats(corners),
            "NORMAL": self.glb.floats([(0, 0, 1)] * 4),
            "TEXCOORD_0": self.glb.floats(uv),
        }
        self.material: dict[str, Any] = {"extensions": {"KHR_materials_specular": {"specularFactor": 0}}}

    def texture(
        self,
        codes: Shaped[np.ndarray, "h w c"],
        sampler: dict[str, Any] | None = None,
        **info: Any,  # noqa: ANN401 - whatever a `textureInfo` holds
    ) -> dict[str, Any]:
        """Stores a picture (h, w, 3 or 4; R G B A bytes) as PNG; returns the `textureInfo` of a material."""
        order = cv2.COLOR_RGB2BGR if codes.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        data = cv2.imencode(".png", cv2.cvtColor(np.asarray(codes, np.uint8), order))[1]
        return self.encoded(data.tobytes(), sampler, **info)

    def encoded(
        self,
        data: bytes,
        sampler: dict[str, Any] | None = None,
        mime: str = "image/png",
        **info: Any,  # noqa: ANN401 - as above
    ) -> dict[str, Any]:
        """Stores the bytes of a picture file; returns the `textureInfo` of a material."""
        view = self.glb.view(np.frombuffer(data, np.uint8))
        texture = {"source": self.glb.add("images", {"bufferView": view, "mimeType": mime})}
        if sampler is not None:
            texture["sampler"] = self.glb.add("samplers", sampler)
        return {"index": self.glb.add("textures", texture), **info}

    def write(self, path: Path, node: dict[str, Any] | None = None) -> Path:
        """Writes the file; `node`: the plate's transform."""
        indices = self.glb.array(np.array([0, 1, 2, 0, 2, 3], np.uint16))
        part = {"attributes": self.attributes, "indices": indices, "material": 0}
        self.glb.add("materials", self.material)
        self.glb.add("nodes", {**(node or {}), "mesh": self.glb.add("meshes", {"primitives": [part]})})
        return self.glb.write(path)


def even(*code: int, size: int = 4) -> UInt8[np.ndarray, "h w c"]:
    """Returns a picture of one colour."""
    return np.full((size, size, len(code)), code, np.uint8)
