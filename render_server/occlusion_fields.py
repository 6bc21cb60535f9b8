"""Occlusion fields of a scene's objects: loaded from disk, or computed before or during rendering."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import structlog
from rich.console import Console
from rich.progress import Progress

from protocol.errors import DeltalightError
from protocol.scene_objects import SceneObject
from render_server.gpu_scene import PlacedObject
from render_server.scene.occlusion_cache import (
    compute_field,
    default_folder,
    field_digest,
    load_field,
    store_field,
)
from render_server.scene.occlusion_field import FieldSettings, OcclusionField, ProgressCallback
from render_server.scene.occlusion_transfer import object_surface
from render_server.scene.triangle_mesh import TriangleMesh

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
        self._folder = folder or default_folder()
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
        except Exception as error:  # whatever failed, the picture goes on without this shadow
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
