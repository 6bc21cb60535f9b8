"""A glTF 2 document with its bytes, and the arrays that it describes (glTF 2.0, section 3.6)."""

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float32, Shaped

from protocol.errors import DeltalightError

if TYPE_CHECKING:
    from PIL import Image

COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class GltfFaultError(Exception):
    """What is wrong inside a glTF document; becomes a sentence with the file's name."""


@contextmanager
def faults_named(path: Path) -> Iterator[None]:
    """Turn everything that a malformed document can raise into a DeltalightError that names the file."""
    try:
        yield
    except GltfFaultError as fault:
        raise DeltalightError(f"{path}: {fault}; export the mesh again.") from fault
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise DeltalightError(f"{path} is not a valid glTF 2 file ({error!r}); export it again.") from error


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A document whose sizes hold (asset_check.py)."""

    path: Path
    document: dict[str, Any]
    buffers: tuple[bytes, ...]

    def entries(self, name: str) -> list[dict[str, Any]]:
        """A top-level list of the document."""
        return list(self.document.get(name, []))

    def array(self, index: int) -> Shaped[np.ndarray, "n c"]:
        """Rows of an accessor: as stored, or float32 if it is normalised (then -1..1 or 0..1)."""
        accessor = self.document["accessors"][index]
        columns, kind = COMPONENTS[accessor["type"]], np.dtype(COMPONENT_TYPES[accessor["componentType"]])
        if "bufferView" in accessor:
            rows = self._rows(accessor, accessor["count"], columns, kind)
        else:
            rows = np.zeros((accessor["count"], columns), kind)
        if "sparse" in accessor:
            rows = self._with_sparse(rows, accessor["sparse"])
        return _normalised(rows) if accessor.get("normalized", False) else rows

    def floats(self, index: int, columns: int) -> Float32[np.ndarray, "n c"]:
        """Rows of an accessor as float32.

        Raises:
            GltfFaultError: it has another number of columns or holds what is not finite.
        """
        rows = self.array(index).astype(np.float32)
        if rows.shape[1] != columns:
            raise GltfFaultError(f"accessor {index} has {rows.shape[1]} components where {columns} belong")
        if not np.isfinite(rows).all():
            raise GltfFaultError(f"accessor {index} holds numbers that are not finite")
        return rows

    def _rows(
        self, place: dict[str, Any], count: int, columns: int, kind: np.dtype[Any]
    ) -> Shaped[np.ndarray, "n c"]:
        view = self.document["bufferViews"][place["bufferView"]]
        offset = view.get("byteOffset", 0) + place.get("byteOffset", 0)
        width = columns * kind.itemsize
        stride = view.get("byteStride", width)
        data = np.frombuffer(self.buffers[view["buffer"]], np.uint8)[offset:]
        rows = np.lib.stride_tricks.as_strided(data, (count, width), (stride, 1), writeable=False)
        return np.ascontiguousarray(rows).view(kind)

    def _with_sparse(
        self, rows: Shaped[np.ndarray, "n c"], sparse: dict[str, Any]
    ) -> Shaped[np.ndarray, "n c"]:
        kind = np.dtype(COMPONENT_TYPES[sparse["indices"]["componentType"]])
        places = self._rows(sparse["indices"], sparse["count"], 1, kind)[:, 0]
        replaced = rows.copy()
        replaced[places] = self._rows(sparse["values"], sparse["count"], rows.shape[1], rows.dtype)
        return replaced

    def texture(self, index: int) -> "Image.Image | None":
        """The picture of a texture, not yet decoded; None where it is of a kind that is not read.

        Raises:
            GltfFaultError: it is missing or no picture.
        """
        from PIL import Image

        texture = self.document["textures"][index]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.get("source"))
        if source is None:
            return None
        try:
            return Image.open(io.BytesIO(self._image_bytes(self.document["images"][source])))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise GltfFaultError(f"its image {source} cannot be read ({error})") from error

    def _image_bytes(self, image: dict[str, Any]) -> bytes:
        if "uri" in image:
            return uri_bytes(image["uri"], self.path.parent)
        view = self.document["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return bytes(self.buffers[view["buffer"]][start : start + view["byteLength"]])


def uri_bytes(uri: str, folder: Path) -> bytes:
    """What a URI of a document stands for: data of its own, or a file inside the document's folder."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition("base64,")[2])
    path = file_inside(uri, folder)
    if not path.is_file():
        raise GltfFaultError(f"the file {uri} that it refers to is missing")
    return path.read_bytes()


def file_inside(uri: str, folder: Path) -> Path:
    """The file that a URI names; it must lie inside `folder`."""
    path = (folder / unquote(uri)).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise GltfFaultError(f"it refers to {uri}, outside its own folder")
    return path


def _normalised(rows: Shaped[np.ndarray, "n c"]) -> Float32[np.ndarray, "n c"]:
    """Integers as shares of their greatest value (glTF 2.0, section 3.11)."""
    if rows.dtype.kind == "f":
        return rows.astype(np.float32)
    shares = rows.astype(np.float32) / np.float32(np.iinfo(rows.dtype).max)
    return np.asarray(np.maximum(shares, np.float32(-1)))
