"""Precomputed light transfer of a scene's objects: settings, files, and the computation of what the cache lacks."""

import hashlib
from collections.abc import Hashable
from dataclasses import astuple
from pathlib import Path

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import SceneObject
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.precomputation.job_cache import Job, Precomputations, load_arrays, store_arrays
from deltalight.render_server.scene.precomputed_transfer import (
    ObjectTransfer,
    TransferSettings,
    TransferSurface,
    compute_object_transfer,
    transfer_surface,
)

TRANSFER_VERSION = 1  # rises when the same input gives another transfer
CACHE = "precomputed-transfer"


def transfer_settings(shading: Shading) -> TransferSettings:
    """Returns the settings of the document that a transfer depends on."""
    return TransferSettings(round(shading.coefficients**0.5), shading.bounces, shading.rays)


def transfer_digest(surface: TransferSurface, settings: TransferSettings) -> str:
    """Returns 16 hexadecimal digits that change with the object's triangles, its reflectance, or the settings.

    Reflectance counts only with bounces.
    """
    hasher = hashlib.sha256(repr((TRANSFER_VERSION, astuple(settings))).encode())
    counting = [surface.positions, surface.normals, surface.triangles]
    if settings.bounces:
        counting.append(surface.reflectance)
    for array in counting:
        hasher.update(repr(array.shape).encode())
        hasher.update(np.ascontiguousarray(array).tobytes())
    return hasher.hexdigest()[:16]


def store_transfer(folder: Path, digest: str, made: ObjectTransfer) -> None:
    """Writes a transfer; evicts the least recently used ones beyond the limit of the cache.

    Raises:
        DeltalightError: the folder cannot be written.
    """
    store_arrays(folder / f"{digest}.npz", digest=np.array(digest), transfer=made.transfer)


def load_transfer(
    folder: Path, digest: str, surface: TransferSurface, settings: TransferSettings
) -> ObjectTransfer | None:
    """Reads the transfer of a surface; None if there is none, or the file is damaged or of another mesh."""
    arrays = load_arrays(folder / f"{digest}.npz")
    if arrays is None or str(arrays.get("digest")) != digest:
        return None
    transfer = arrays.get("transfer")
    wanted = (len(surface.positions), settings.order**2, 4)
    if transfer is None or transfer.dtype != np.float16 or transfer.shape != wanted:
        return None
    if not np.isfinite(transfer).all():
        return None
    return ObjectTransfer(surface.positions, surface.normals, surface.triangles, transfer)


class ObjectTransfers(Precomputations[TransferSettings, ObjectTransfer]):
    """The transfer of a renderer's objects."""

    cache, kind, meanwhile = CACHE, "light transfer", "it keeps no light off itself"

    def _surface_key(self, item: PlacedObject) -> Hashable:
        return None if item.material is None else item.material.diffuse_reflectance.tobytes()

    def _job(self, item: PlacedObject, settings: TransferSettings) -> Job[ObjectTransfer]:
        surface = transfer_surface(item.meshes, item.material)
        digest = transfer_digest(surface, settings)
        return Job(
            lambda: load_transfer(self._folder, digest, surface, settings),
            lambda step: compute_object_transfer(surface, settings, step),
            lambda made: store_transfer(self._folder, digest, made),
        )


def require_rigid_transfer(item: SceneObject) -> None:
    """Refuses an object whose shape may change.

    Raises:
        DeltalightError: it plays an animation, or is not rigid.
    """
    if item.playing is not None:
        raise DeltalightError(
            f"object `{item.id}` is animated or not rigid, and shading `precomputed` holds for rigid objects only: "
            "use image_based, or give it `rigid: true` and no animation."
        )
