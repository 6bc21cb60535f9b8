"""Nothing is lost by kill -9: a process that writes in a loop is killed 50 times at any point."""

import sqlite3
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from deltalight.services.storage.documents import patch_document
from deltalight.services.storage.store import Store
from tests.services.killed_writer import CYCLES, KilledWriter
from tests.services.storage_samples import TETRAHEDRON, trusting_probe, upload

pytestmark = pytest.mark.slow(seconds=30)
# Makes a revision some 30 kB, so that the log is moved into the database several times during the test.
LAMPS = [{"type": "sphere", "position_m": [0, 0, 1 + index / 100]} for index in range(64)]


def write_until_killed(acknowledge: Connection, folder: Path, seed: int, database: str | None) -> None:
    """Makes revisions, undoes some, uploads assets; tells of each when the store has said that it is done."""
    with Store(folder, database=database, probe=trusting_probe) as store:
        scene_id = store.scenes.create({"name": f"process {seed}", "lights": {"manual": LAMPS}}).head.id
        acknowledge.send((scene_id, 1, f"process {seed}"))
        number = 0
        while True:
            number += 1
            name = f"{seed}-{number}"
            scene = store.scenes.change(scene_id, patch_document({"name": name}), "renamed")
            acknowledge.send((scene_id, scene.document.revision, name))
            if number % 3 == 0:
                scene = store.scenes.undo(scene_id)
                acknowledge.send((scene_id, scene.document.revision, scene.document.name))
            if number % 2 == 0:
                asset = upload(store, TETRAHEDRON + f"# {name}\n".encode(), f"{name}.obj")
                acknowledge.send((asset.digest,))


def test_nothing_acknowledged_is_lost_by_kill_9(tmp_path: Path, database: str | None) -> None:
    writer = KilledWriter(write_until_killed, most_awaited=8, longest_delay_s=0.02)
    revisions: list[tuple[str, int, str]] = []
    digests: list[str] = []
    for seed in range(CYCLES):
        for entry in writer.run(seed, tmp_path, seed, database):
            if len(entry) == 1:
                digests += entry
            else:
                revisions.append(entry)
    if database is None:
        connection = sqlite3.connect(tmp_path / "store.sqlite3")
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
        connection.close()
    with Store(tmp_path, database=database, probe=trusting_probe) as store:
        assert len({scene_id for scene_id, _, _ in revisions}) == CYCLES
        for scene_id, number, name in revisions:
            assert store.scenes.revision(scene_id, number).document.name == name
        for head in store.scenes.all():
            numbers = [each.number for each in store.scenes.history(head.id, None, 100_000)]
            assert numbers == list(range(head.revision, 0, -1))
        for asset in store.assets.all():
            assert store.assets.path(asset).stat().st_size == asset.size_bytes
        assert {asset.digest for asset in store.assets.all()} >= set(digests)
    assert len(digests) > 0  # the processes did live long enough to be caught at all of their work
