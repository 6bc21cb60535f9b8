"""The initial scene of this host's processes: the active one of its data folder, or an imported one."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from protocol.scene import SceneDocument, load_scene
from protocol.source import Source
from services.files import write_bytes
from services.storage.scene_files import import_document
from services.storage.store import Store

FIRST_SCENE = "First scene"


@contextmanager
def session_file(scene: SceneDocument) -> Iterator[Path]:
    """Yield a temporary file with the scene document, for the render server's `--session`."""
    with TemporaryDirectory(prefix="deltalight-") as folder:
        path = Path(folder) / "scene.json"
        write_bytes(path, scene.model_dump_json(indent=1).encode())
        yield path


def activate_document(store: Store, document: SceneDocument) -> SceneDocument:
    """Store a document and its files, activate it, and return it as a render server expects it.

    Raises:
        DeltalightError: one of its files is wrong.
    """
    stored = store.scenes.activate(import_document(store, document))
    return store.assets.localised(stored.document)


def scene_to_show(store: Store, source: Source | None, path: Path | None) -> SceneDocument:
    """Return the initial document: that of `path`, else the store's active one, else the recording's.

    Creates an empty scene if there is none.

    Raises:
        DeltalightError: the document or one of its files is wrong.
    """
    if path is not None:
        return activate_document(store, load_scene(path))
    active = store.scenes.active()
    if active is not None:
        return store.assets.localised(active.document)
    brought = None if source is None else source.scene
    return activate_document(store, brought or SceneDocument(name=FIRST_SCENE))
