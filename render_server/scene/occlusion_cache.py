"""Occlusion fields on disk, addressed by content: computed once per asset and settings."""

import hashlib
import os
from dataclasses import astuple
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float32

from protocol.files import replacing
from render_server.scene.occlusion_field import (
    FieldSettings,
    ObjectRays,
    OcclusionField,
    ProgressCallback,
    ShellGrid,
    compute_occlusion,
    place_shells,
)
from render_server.scene.occlusion_transfer import LENGTH, compute_transfer, surface_pieces

FIELD_VERSION = 1  # increment when the same input gives another field
CACHE_VARIABLE = "DELTALIGHT_CACHE"
OCCLUSION_FRACTION = 0.8  # of the computing time


def default_folder() -> Path:
    """Returns `occlusion-fields` in DELTALIGHT_CACHE, else in the user's cache folder."""
    given = os.environ.get(CACHE_VARIABLE)
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (Path(given) if given else user / "deltalight") / "occlusion-fields"


def field_digest(surface: Float32[np.ndarray, "m 3 6"], settings: FieldSettings) -> str:
    """Returns 16 hexadecimal digits that change with the object's triangles, its colours, or the settings.

    Colours count only with indirect light.
    """
    hasher = hashlib.sha256(repr((FIELD_VERSION, astuple(settings))).encode())
    counting = surface if settings.indirect else surface[..., :3]
    hasher.update(np.ascontiguousarray(counting, np.float32).tobytes())
    return hasher.hexdigest()[:16]


def compute_field(
    surface: Float32[np.ndarray, "m 3 6"], settings: FieldSettings, progress: ProgressCallback
) -> OcclusionField:
    """Computes the field of an object (`object_surface`, asset's frame); takes seconds.

    Raises:
        DeltalightError: the package embreex is not installed.
    """
    rays = ObjectRays(np.ascontiguousarray(surface[..., :3]))
    grid = place_shells(rays, settings)
    occlusion = compute_occlusion(
        rays, grid, settings, lambda fraction: progress(OCCLUSION_FRACTION * fraction)
    )
    transfer = None
    if settings.indirect:
        pieces = surface_pieces(surface, rays.radius)
        later = 1 - OCCLUSION_FRACTION
        transfer = compute_transfer(
            pieces, grid, settings, lambda fraction: progress(OCCLUSION_FRACTION + later * fraction)
        )
    return OcclusionField(grid, rays.radius, occlusion, transfer)


def store_field(folder: Path, digest: str, field: OcclusionField) -> None:
    """Writes a field; the file appears when it is complete.

    Raises:
        DeltalightError: the folder cannot be written.
    """
    arrays = {"centre": field.grid.centre, "halves": field.grid.halves}
    arrays |= {"radius": np.array(field.radius), "occlusion": field.occlusion}
    if field.transfer is not None:
        arrays["transfer"] = field.transfer
    with replacing(folder / f"{digest}.npz") as temporary:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(temporary, allow_pickle=False, **arrays)


def load_field(folder: Path, digest: str, settings: FieldSettings) -> OcclusionField | None:
    """Reads a field; None if there is none, or if the file is damaged and must be replaced."""
    try:
        with np.load(folder / f"{digest}.npz", allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, BadZipFile, EOFError, NotImplementedError):
        return None
    if not _is_whole(arrays, settings):
        return None
    grid = ShellGrid(arrays["centre"], arrays["halves"])
    radius = float(arrays["radius"])
    return OcclusionField(grid, radius, arrays["occlusion"], arrays.get("transfer"))


def _is_whole(arrays: dict[str, np.ndarray], settings: FieldSettings) -> bool:
    """Whether all arrays are there, in the shape that the settings require, and finite."""
    shells, n = settings.shells, settings.resolution
    shapes: dict[str, tuple[int, ...]] = {"centre": (3,), "halves": (shells, 3), "radius": ()}
    shapes["occlusion"] = (shells, n, n, n, settings.order**2)
    if settings.indirect:
        shapes["transfer"] = (shells, *[n // 2] * 3, LENGTH, LENGTH, 3)
    if {name: arrays[name].shape for name in shapes if name in arrays} != shapes:
        return False
    return all(array.dtype.kind == "f" and np.isfinite(array).all() for array in arrays.values())
