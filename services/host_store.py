"""Scenes of this host's data folder: import of documents with their files, and the initial scene of its processes.

Only the command line imports files by their paths, never a REST client.
"""

from contextlib import suppress
from pathlib import Path

from deltalight.protocol.scene import DIGEST_PREFIX, SceneDocument, load_scene
from deltalight.protocol.source import Source
from deltalight.services.api.settings import ApiSettings
from deltalight.services.settings import load_configuration
from deltalight.services.storage.faults import ConflictError, NotFoundError
from deltalight.services.storage.store import Store

FIRST_SCENE = "First scene"
CHUNK_BYTES = 1 << 20
LIMIT_BYTES = 512 << 20


def open_store(folder: Path, config_file: Path | None = None, database: str | None = None) -> Store:
    """Opens the store of a data folder, with the database and the store of assets of the configuration.

    Raises:
        DeltalightError: it cannot be used.
    """
    settings = load_configuration(config_file).section("api", ApiSettings)
    return Store(folder, database=database or settings.database, assets=settings.assets)


def activate_document(store: Store, document: SceneDocument) -> SceneDocument:
    """Stores a document and its files, activate it, and returns it as a render server expects it.

    Raises:
        DeltalightError: one of its files is wrong.
    """
    stored = store.scenes.activate(import_document(store, document))
    return store.assets.localised(stored.document)


def activate_first(store: Store, document: SceneDocument) -> None:
    """Stores a document and its files and activate it, unless another web process was faster.

    Raises:
        DeltalightError: one of its files is wrong.
    """
    before = {head.id for head in store.scenes.all()}
    scene_id = import_document(store, document)
    if not store.scenes.activate_first(scene_id) and scene_id not in before:
        # The faster one shows this very scene, or another slow one that shared it was first to delete it.
        with suppress(ConflictError, NotFoundError):
            store.scenes.delete(scene_id)


def scene_to_show(store: Store, source: Source | None, path: Path | None) -> SceneDocument:
    """Returns the initial document: that of `path`, else the store's active one, else the recording's.

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


def import_scene(store: Store, path: Path) -> str:
    """Stores a scene document and its assets; returns the id of the scene, an old one if nothing differs.

    Raises:
        DeltalightError: the document or one of its files is wrong.
    """
    return import_document(store, load_scene(path), f"imported from {path.name}")


def import_document(store: Store, document: SceneDocument, what: str = "imported") -> str:
    """Imports a document whose assets are absolute paths, like `import_scene`."""
    kept = document.with_assets(lambda _place, asset: _keep(store, asset))
    for head in store.scenes.all():
        with suppress(NotFoundError):  # another process may have deleted it meanwhile
            if _same(store.scenes.get(head.id).document, kept):
                return head.id
    return store.scenes.create(kept.model_dump(mode="json"), what).head.id


def _same(one: SceneDocument, other: SceneDocument) -> bool:
    return one.replaced(revision=0) == other.replaced(revision=0)


def _keep(store: Store, asset: str) -> str:
    if asset.startswith(DIGEST_PREFIX):
        return asset
    with Path(asset).open("rb") as file, store.assets.receiving(LIMIT_BYTES) as incoming:
        while chunk := file.read(CHUNK_BYTES):
            incoming.write(chunk)
        return store.assets.keep(incoming, Path(asset).name)[0].reference
