"""Files of precomputed materials: written once by `deltalight precompute`, named by `material: {precomputed: FILE}`.

A line `deltalight material VERSION SHA256`, then a .npz archive of arrays, of which that is the hash.
"""

import hashlib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes
from deltalight.render_server.scene import polynomial_texture, texture_stack
from deltalight.render_server.scene.gaussian_brdf import MOST_LOBES, RISE_TERMS, GaussianBrdf
from deltalight.render_server.scene.polynomial_texture import TERMS, PolynomialTexture
from deltalight.render_server.scene.texture_stack import BRIGHTEST, LAYERS, TextureStack

MATERIAL_SUFFIX = ".dlmat"
PrecomputedMaterial = GaussianBrdf | PolynomialTexture | TextureStack
VERSION = 1
_MAGIC = b"deltalight material "
_LARGEST_BYTES = 16 << 20  # of the arrays
_ADVICE = "make it with `deltalight precompute SOURCE --out FILE.dlmat`"


def write_material(path: Path, material: PrecomputedMaterial) -> None:
    """Writes a precomputed material, atomically.

    Raises:
        DeltalightError: the disk refuses.
    """
    stream = BytesIO()
    np.savez_compressed(stream, **_arrays_of(material))
    content = stream.getvalue()
    head = _MAGIC + f"{VERSION} {hashlib.sha256(content).hexdigest()}\n".encode()
    write_bytes(path, head + content)


def _arrays_of(material: PrecomputedMaterial) -> dict[str, Any]:
    match material:
        case PolynomialTexture():
            return {"coefficients": material.coefficients}
        case TextureStack():
            return {"layers": material.layers, "coat": np.array([material.f0, material.roughness])}
    return {"diffuse": material.diffuse, "sigmas": material.sigmas, "weights": material.weights}


def read_material(path: Path) -> PrecomputedMaterial:
    """Reads a file of `write_material`.

    Raises:
        DeltalightError: it cannot be read, is of another kind or version, damaged, or holds what is no such material.
    """
    try:
        with path.open("rb") as file:
            head, content = file.readline(200), file.read(_LARGEST_BYTES + 1)
    except OSError as error:
        raise DeltalightError(f"{path} cannot be read ({error.strerror}); {_ADVICE}.") from error
    if not head.startswith(_MAGIC) or len(head.split()) != 4:
        raise DeltalightError(f"{path} is not a precomputed material; {_ADVICE}.")
    version, digest = head.split()[2:]
    if version != str(VERSION).encode():
        raise DeltalightError(
            f"{path} is a precomputed material of version {version.decode(errors='replace'):.20}, and this "
            f"release reads version {VERSION}; {_ADVICE}."
        )
    if len(content) > _LARGEST_BYTES:
        raise DeltalightError(
            f"{path} is larger than {_LARGEST_BYTES >> 20} MB, too large for a material; {_ADVICE}."
        )
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise DeltalightError(f"{path} is damaged or cut short; {_ADVICE} again.")
    made = _made(_unpacked(content))
    if made is None:
        raise DeltalightError(f"{path} holds no material that can be drawn; {_ADVICE} again.")
    return made


def _unpacked(content: bytes) -> Mapping[str, object]:
    """Returns the arrays of a material's archive by name; empty if the file is no such archive."""
    try:
        with ZipFile(BytesIO(content)) as archive:
            if sum(item.file_size for item in archive.infolist()) > _LARGEST_BYTES:
                return {}
        with np.load(BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # zipfile, zlib and numpy's parser of headers raise many kinds
        return {}


def _made(arrays: Mapping[str, Any]) -> PrecomputedMaterial | None:
    """Returns the material that the arrays describe; None if they describe none."""
    # A member that is no array comes as bytes.
    if any(not isinstance(each, np.ndarray) or each.dtype.kind != "f" for each in arrays.values()):
        return None
    if arrays.keys() == {"coefficients"}:
        return _polynomial(arrays["coefficients"])
    if arrays.keys() == {"layers", "coat"}:
        return _stack(arrays["layers"], arrays["coat"])
    if arrays.keys() == {"diffuse", "sigmas", "weights"}:
        return _gaussians(
            *(np.asarray(arrays[name], np.float64) for name in ("diffuse", "sigmas", "weights"))
        )
    return None


def _polynomial(coefficients: np.ndarray) -> PolynomialTexture | None:
    if not _are_planes(coefficients, TERMS, polynomial_texture.MOST_TEXELS_EDGE):
        return None
    return PolynomialTexture(coefficients.astype(np.float16))


def _stack(layers: np.ndarray, coat: np.ndarray) -> TextureStack | None:
    whole = _are_planes(layers, LAYERS, texture_stack.MOST_TEXELS_EDGE) and coat.shape == (2,)
    if (
        not whole
        or not ((layers >= 0) & (layers <= BRIGHTEST)).all()
        or not ((coat >= 0) & (coat <= 1)).all()
    ):
        return None
    return TextureStack(layers.astype(np.float16), *map(float, coat))


def _are_planes(array: np.ndarray, count: int, most_edge: int) -> bool:
    """Whether these are so many textures of finite R G B."""
    shape = array.shape
    fits = len(shape) == 4 and shape[0] == count and shape[3] == 3 and 0 < max(shape[1:3]) <= most_edge
    return fits and array.size > 0 and bool(np.isfinite(array).all())


def _gaussians(diffuse: np.ndarray, sigmas: np.ndarray, weights: np.ndarray) -> GaussianBrdf | None:
    count = len(sigmas) if sigmas.ndim == 1 else 0
    shapes = diffuse.shape == (3,) and weights.shape == (count, RISE_TERMS, 3) and count <= MOST_LOBES
    finite = all(np.isfinite(each).all() and (each >= 0).all() for each in (diffuse, sigmas, weights))
    if not (shapes and finite and (sigmas > 1e-3).all() and (sigmas <= np.pi / 2).all()):
        return None
    return GaussianBrdf(diffuse, sigmas, weights)
