"""Occlusion fields of a scene's objects: settings, files, and the computation of what the cache lacks."""

import hashlib
from dataclasses import astuple
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_method import AroofMethod
from deltalight.protocol.scene_objects import SceneObject
from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.precomputation.job_cache import (
    Checkpoint,
    Job,
    Precomputations,
    load_arrays,
    store_arrays,
)
from deltalight.render_server.scene.occlusion_field import (
    FieldSettings,
    ObjectRays,
    OcclusionField,
    PartKeeper,
    ProgressCallback,
    ShellGrid,
    compute_occlusion,
    compute_part,
    place_shells,
)
from deltalight.render_server.scene.occlusion_transfer import (
    LENGTH,
    compute_transfer,
    object_surface,
    surface_pieces,
)

FIELD_VERSION = 1  # rises when the same input gives another field
CACHE = "occlusion-fields"
OCCLUSION_FRACTION = 0.8  # of the computing time


def field_settings(settings: AroofMethod) -> FieldSettings:
    """Returns the settings of the method that a field depends on."""
    return FieldSettings(
        settings.sh_order,
        settings.shells,
        settings.resolution,
        settings.reach,
        settings.rays,
        settings.indirect,
    )


def field_digest(surface: Float32[np.ndarray, "m 3 6"], settings: FieldSettings) -> str:
    """Returns 16 hexadecimal digits that change with the object's triangles, its colours, or the settings.

    Colours count only with indirect light.
    """
    hasher = hashlib.sha256(repr((FIELD_VERSION, astuple(settings))).encode())
    counting = surface if settings.indirect else surface[..., :3]
    hasher.update(np.ascontiguousarray(counting, np.float32).tobytes())
    return hasher.hexdigest()[:16]


def compute_field(
    surface: Float32[np.ndarray, "m 3 6"],
    settings: FieldSettings,
    progress: ProgressCallback,
    keep: PartKeeper = compute_part,
) -> OcclusionField:
    """Computes the field of an object (`object_surface`, asset's frame), shell by shell; takes seconds to minutes.

    Raises:
        DeltalightError: no package that traces rays is installed.
    """
    rays = ObjectRays(np.ascontiguousarray(surface[..., :3]))
    grid = place_shells(rays, settings)
    occlusion = compute_occlusion(
        rays, grid, settings, lambda fraction: progress(OCCLUSION_FRACTION * fraction), keep
    )
    transfer = None
    if settings.indirect:
        pieces = surface_pieces(surface, rays.radius)
        later = 1 - OCCLUSION_FRACTION
        transfer = compute_transfer(
            pieces, grid, settings, lambda fraction: progress(OCCLUSION_FRACTION + later * fraction), keep
        )
    return OcclusionField(grid, rays.radius, occlusion, transfer)


def store_field(folder: Path, digest: str, field: OcclusionField) -> None:
    """Writes a field; evicts the least recently used ones beyond the limit of the cache.

    Raises:
        DeltalightError: the folder cannot be written.
    """
    arrays = {"centre": field.grid.centre, "halves": field.grid.halves}
    arrays |= {"radius": np.array(field.radius), "occlusion": field.occlusion}
    if field.transfer is not None:
        arrays["transfer"] = field.transfer
    store_arrays(folder / f"{digest}.npz", **arrays)


def load_field(folder: Path, digest: str, settings: FieldSettings) -> OcclusionField | None:
    """Reads a field; None if there is none, or if the file is damaged and must be replaced."""
    arrays = load_arrays(folder / f"{digest}.npz")
    if arrays is None or not _is_whole(arrays, settings):
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


class OcclusionFields(Precomputations[FieldSettings, OcclusionField]):
    """The fields of a renderer's objects."""

    cache, kind, meanwhile = CACHE, "occlusion field", "it keeps off no natural light"

    def _surface_key(self, item: PlacedObject) -> bool:
        return item.material is not None

    def _job(self, item: PlacedObject, settings: FieldSettings) -> Job[OcclusionField]:
        surface = object_surface(item.meshes, plain=item.material is not None)
        digest = field_digest(surface, settings)
        checkpoint = Checkpoint(self._folder, digest)
        return Job(
            lambda: load_field(self._folder, digest, settings),
            lambda step: compute_field(surface, settings, step, checkpoint.part),
            lambda made: store_field(self._folder, digest, made),
            checkpoint,
        )


def require_rigid(item: SceneObject) -> None:
    """Refuses an object whose shape may change, because occlusion is precomputed.

    Raises:
        DeltalightError: it plays an animation, or is not rigid.
    """
    if item.playing is not None:
        raise DeltalightError(
            f"object `{item.id}` is animated or not rigid, and method aroof precomputes what objects hide: "
            "use dvct or dlpv, or give it `rigid: true` and no animation."
        )
