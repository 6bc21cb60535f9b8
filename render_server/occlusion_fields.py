"""The occlusion fields of a scene's objects: found on disk by content, or computed before or beside rendering."""

import hashlib
import threading
from collections.abc import Callable
from dataclasses import astuple, dataclass
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import structlog
from jaxtyping import Float32
from rich.console import Console
from rich.progress import Progress

from deltalight.protocol.cached_files import (
    cache_folder,
    cache_limit_bytes,
    mark_used,
    prune,
    read_cached,
    write_cached,
)
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import SceneObject
from deltalight.render_server.gpu_scene import PlacedObject
from deltalight.render_server.scene.occlusion_field import (
    FieldSettings,
    ObjectRays,
    OcclusionField,
    ProgressCallback,
    ShellGrid,
    compute_occlusion,
    place_shells,
)
from deltalight.render_server.scene.occlusion_transfer import (
    LENGTH,
    compute_transfer,
    object_surface,
    surface_pieces,
)
from deltalight.render_server.scene.triangle_mesh import TriangleMesh

FIELD_VERSION = 1  # rises when the same input gives another field
CACHE = "occlusion-fields"
OCCLUSION_FRACTION = 0.8  # of the computing time


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
        DeltalightError: no package that traces rays is installed.
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
    """Writes a field, and removes those that were not used for longest beyond the limit of the cache.

    Raises:
        DeltalightError: the folder cannot be written.
    """
    arrays = {"centre": field.grid.centre, "halves": field.grid.halves}
    arrays |= {"radius": np.array(field.radius), "occlusion": field.occlusion}
    if field.transfer is not None:
        arrays["transfer"] = field.transfer
    stream, path = BytesIO(), folder / f"{digest}.npz"
    np.savez(stream, allow_pickle=False, **arrays)
    write_cached(path, stream.getvalue())
    prune(folder, cache_limit_bytes(), keep=path)


def load_field(folder: Path, digest: str, settings: FieldSettings) -> OcclusionField | None:
    """Reads a field; None if there is none, or if the file is damaged and must be replaced."""
    path = folder / f"{digest}.npz"
    content = read_cached(path)
    if content is None:
        return None
    mark_used(path)
    try:
        with np.load(BytesIO(content), allow_pickle=False) as file:
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


log = structlog.get_logger()


class _EndedError(Exception):
    """The renderer was released; nobody waits for the field."""


@dataclass(eq=False)
class _Entry:
    """One asset's field with one set of settings; holds `meshes`, whose identities are its key."""

    meshes: tuple[TriangleMesh, ...]
    name: str
    field: OcclusionField | None = None
    fault: str | None = None
    thread: threading.Thread | None = None


class OcclusionFields:
    """Caches fields for the lifetime of a renderer; `notify` receives sentences for the user.

    With `waits`, `find` blocks until a field is ready and shows a progress bar on a terminal. Without, a
    thread computes it (embree and matrix products release the interpreter lock) and `find` returns None
    meanwhile.
    """

    def __init__(
        self, notify: Callable[[str], None], folder: Path | None = None, *, waits: bool = True
    ) -> None:
        self.waits = waits
        self._notify = notify
        self._folder = folder or cache_folder(CACHE)
        self._entries: dict[tuple[object, ...], _Entry] = {}
        self._one_at_a_time = threading.Lock()
        self._ended = threading.Event()

    def find(self, item: PlacedObject, settings: FieldSettings) -> OcclusionField | None:
        """Returns the field of an object's asset; None while it is being computed.

        Raises:
            DeltalightError: the field cannot be computed.
        """
        plain = item.material is not None
        key = (*(id(mesh) for mesh in item.meshes), plain, settings)
        entry = self._entries.get(key)
        if entry is None:
            entry = self._entries[key] = _Entry(item.meshes, item.id)
            self._begin(entry, settings, plain=plain)
        if entry.thread is not None and self.waits:
            entry.thread.join()
        if entry.fault is not None:
            self._notify(entry.fault)
        return entry.field

    def _begin(self, entry: _Entry, settings: FieldSettings, *, plain: bool) -> None:
        surface = object_surface(entry.meshes, plain=plain)
        digest = field_digest(surface, settings)
        entry.field = load_field(self._folder, digest, settings)
        if entry.field is not None:
            return

        def make(step: ProgressCallback) -> None:
            made = compute_field(surface, settings, step)
            try:
                store_field(self._folder, digest, made)
            except DeltalightError as error:
                entry.fault = f"object `{entry.name}`: its occlusion field is not kept: {error}"
            entry.field = made

        if self.waits:
            with Progress(console=Console(stderr=True), transient=True) as progress:
                task = progress.add_task(f"occlusion field of `{entry.name}`", total=1.0)
                make(lambda fraction: progress.update(task, completed=fraction))
            return
        self._notify(
            f"object `{entry.name}`: its occlusion field is being computed, once; until then it keeps off no natural "
            "light."
        )
        entry.thread = threading.Thread(target=self._beside, args=(entry, make), daemon=True)
        entry.thread.start()

    def _beside(self, entry: _Entry, make: Callable[[ProgressCallback], None]) -> None:
        def step(_fraction: float) -> None:
            if self._ended.is_set():
                raise _EndedError

        try:
            with self._one_at_a_time:
                step(0.0)
                make(step)
        except _EndedError:
            pass
        except Exception as error:  # whatever it is, the picture goes on without this shadow
            entry.fault = f"object `{entry.name}`: its occlusion field cannot be computed ({error})."
            log.debug("occlusion field", exc_info=error)

    def release(self) -> None:
        """Lets threads end at their next step."""
        self._ended.set()


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
