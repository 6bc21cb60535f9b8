"""Import of a scene document with the files that it names (for the command line, never for REST clients)."""

from pathlib import Path

from protocol.scene import DIGEST_PREFIX, SceneDocument, load_scene
from services.storage.store import Store

CHUNK_BYTES = 1 << 20
LIMIT_BYTES = 512 << 20


def import_scene(store: Store, path: Path) -> str:
    """Store a scene document and its assets; return the id of the scene, an old one if nothing differs.

    Raises:
        DeltalightError: the document or one of its files is wrong.
    """
    return import_document(store, load_scene(path), f"imported from {path.name}")


def import_document(store: Store, document: SceneDocument, what: str = "imported") -> str:
    """Import a document whose assets are absolute paths, like `import_scene`."""
    kept = document.with_assets(lambda _place, asset: _keep(store, asset))
    for head in store.scenes.all():
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
