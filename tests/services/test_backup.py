"""Backups of the data folder: while it is written to, of damaged parts, cut off, and after a power cut."""

import json
import os
import random
import shutil
import sqlite3
import threading
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage import data_folder
from deltalight.services.storage.backup import MANIFEST, restore_backup, write_backup
from deltalight.services.storage.documents import patch_document
from deltalight.services.storage.store import Store
from tests.services.conftest import RunCli
from tests.services.storage_samples import TETRAHEDRON, trusting_probe, upload

LAMPS = [{"type": "sphere", "position_m": [0, 0, 1 + index / 100]} for index in range(64)]


def filled(folder: Path, name: str = "first") -> str:
    """Makes a store with one scene that uses one asset; returns the scene's id."""
    with Store(folder, probe=trusting_probe) as store:
        upload(store, TETRAHEDRON, "shape.obj")
        scene = store.scenes.create({"name": name, "objects": [{"asset": "shape.obj"}]})
        return store.scenes.activate(scene.head.id).head.id


def shown(folder: Path) -> str:
    """The name of the active scene, whose files are there."""
    with Store(folder, probe=trusting_probe) as store:
        active = store.scenes.active()
        assert active is not None
        store.assets.localised(active.document)
        return active.document.name


def blob(folder: Path) -> Path:
    return next((folder / "assets").glob("*/asset.obj"))


def test_a_backup_of_a_running_store_is_one_moment_and_goes_into_another_folder(tmp_path: Path) -> None:
    scene_id = filled(tmp_path / "data")
    stop, written = threading.Event(), 0

    def write() -> None:
        nonlocal written
        with Store(tmp_path / "data", probe=trusting_probe) as store:
            while not stop.is_set():
                upload(store, TETRAHEDRON + f"# {written}\n".encode(), f"{written}.obj")
                objects = [{"asset": f"{written}.obj"}]
                store.scenes.change(scene_id, patch_document({"name": str(written), "objects": objects}), "x")
                written += 1

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for number in range(5):
            least = written
            contents = write_backup(tmp_path / "data", tmp_path / f"{number}.zip")
            restore_backup(tmp_path / f"{number}.zip", tmp_path / str(number))
            with Store(tmp_path / str(number), probe=trusting_probe) as store:
                scene = store.scenes.get(scene_id)
                store.assets.localised(scene.document)
                assert scene.document.revision == contents.revisions > least
    finally:
        stop.set()
        writer.join()
    assert (tmp_path / "0.zip").stat().st_mode & 0o777 == 0o600


def test_restore_moves_aside_what_was_there_and_says_so(cli: RunCli, tmp_path: Path) -> None:
    data, kept = tmp_path / "data", tmp_path / "kept.zip"
    filled(data)
    (data / "recordings").mkdir()
    done = cli("backup", kept, "--data", data)
    assert done.returncode == 0, done.stderr
    assert "1 scene with 1 revision and 1 asset (" in done.stdout
    shutil.rmtree(data / "assets")
    (data / "store.sqlite3").unlink()
    filled(data, "second")
    done = cli("restore", kept, "--data", data, "--json")
    aside = Path(json.loads(done.stdout)["aside"])
    assert shown(data) == "first"
    assert shown(aside) == "second"
    assert aside.parent == data
    assert (data / "recordings").is_dir()
    assert cli("restore", kept, "--data", tmp_path / "new").returncode == 0
    assert shown(tmp_path / "new") == "first"


def test_what_cannot_be_done_is_one_sentence_and_changes_nothing(cli: RunCli, tmp_path: Path) -> None:
    data, kept = tmp_path / "data", tmp_path / "kept.zip"
    assert "holds no store.sqlite3" in cli("backup", kept, "--data", data).stderr
    filled(data)
    write_backup(data, kept)
    assert "already exists" in cli("backup", kept, "--data", data).stderr
    nowhere = cli("backup", tmp_path / "disk" / "kept.zip", "--data", data).stderr
    assert f"the folder {tmp_path / 'disk'} does not exist; create it" in nowhere
    with Store(data):
        refused = cli("restore", kept, "--data", data)
    assert refused.returncode == 2
    assert "is in use; stop the service" in refused.stderr
    missing = cli("restore", tmp_path / "none.zip", "--data", data).stderr
    assert "none.zip cannot be restored (No such file or directory); check the file" in missing
    assert shown(data) == "first"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "kept.zip"]


def test_every_damage_of_a_backup_is_found_before_anything_changes(tmp_path: Path) -> None:
    data, kept = tmp_path / "data", tmp_path / "kept.zip"
    filled(data)
    write_backup(data, kept)
    whole, choice = kept.read_bytes(), random.Random(5)
    cases = [b"", b"PK\x05\x06" + bytes(18), whole[: len(whole) // 2]]
    for _ in range(40):
        place = choice.randrange(len(whole))
        cases.append(whole[:place] + bytes([whole[place] ^ 1 << choice.randrange(8)]) + whole[place + 1 :])
    refused = 0
    for number, content in enumerate(cases):
        kept.write_bytes(content)
        folder = tmp_path / f"to{number}"
        sentence = ""
        try:
            restore_backup(kept, folder)
        except DeltalightError as refusal:
            sentence = str(refusal)
        if sentence:
            assert str(kept) in sentence
            assert not list(folder.glob("[!.]*"))
            refused += 1
        else:
            assert shown(folder) == "first"  # a bit that means nothing: a date, say
    assert refused > 30


@pytest.mark.parametrize(
    "name", ["../x", "/etc/passwd", "assets/../x", "assets/" + "0" * 64 + "/asset.sh", "store.sqlite3-wal"]
)
def test_a_backup_writes_nothing_but_its_own_files(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        archive.writestr(name, b"")
        files = [{"name": name, "size": 0, "sha256": "0" * 64}]
        archive.writestr(MANIFEST, json.dumps({"format": 1, "files": files}))
    with pytest.raises(DeltalightError, match="not a complete backup"):
        restore_backup(tmp_path / "evil.zip", tmp_path / "data")


def test_damage_of_the_store_names_the_backup(tmp_path: Path) -> None:
    data, kept = tmp_path / "data", tmp_path / "kept.zip"
    filled(data)
    whole = blob(data).read_bytes()
    blob(data).write_bytes(whole[:-1])
    with pytest.raises(DeltalightError, match=r"asset.obj is damaged; .*deltalight restore BACKUP"):
        write_backup(data, kept)
    blob(data).unlink()
    for use in (lambda: write_backup(data, kept), lambda: shown(data)):
        with pytest.raises(DeltalightError, match=r"gone.*; upload .*deltalight restore BACKUP"):
            use()
    with Store(data, probe=trusting_probe) as store:
        upload(store, whole, "shape.obj")
    write_backup(data, kept)
    pages = bytearray((data / "store.sqlite3").read_bytes())
    pages[4096:] = os.urandom(len(pages) - 4096)
    (data / "store.sqlite3").write_bytes(pages)
    for use in (lambda: write_backup(data, tmp_path / "x.zip"), lambda: shown(data)):
        with pytest.raises(DeltalightError, match=r"store.sqlite3 is damaged .*deltalight restore BACKUP"):
            use()
    restore_backup(kept, data)
    assert shown(data) == "first"


def test_a_restore_that_is_cut_off_anywhere_leaves_the_old_or_the_new_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, kept = tmp_path / "data", tmp_path / "kept.zip"
    filled(data, "new")
    write_backup(data, kept)
    rename, found = Path.rename, set[str]()
    for step in range(8):
        folder, done = tmp_path / str(step), 0
        filled(folder, "old")

        def cut(path: Path, to: Path, last: int = step) -> Path:
            nonlocal done
            if done == last:
                raise KeyboardInterrupt
            done += 1
            return rename(path, to)

        with monkeypatch.context() as patch:
            patch.setattr(Path, "rename", cut)
            with suppress(KeyboardInterrupt):
                restore_backup(kept, folder)
        found.add(shown(folder))
        assert (shown(folder) == "old") == (done == 0)
        assert not list(folder.glob(".restoring-*"))
    assert found == {"old", "new"}
    assert data_folder.finish_replacing(data) is None


def revisions(folder: Path, count: int) -> tuple[list[int], str]:
    """Writes revisions with a log that is never moved into the database; returns its size after each of them."""
    reader = sqlite3.connect(folder / "store.sqlite3")
    reader.execute("BEGIN")
    with Store(folder, probe=trusting_probe) as store:
        scene_id = store.scenes.create({"lights": {"manual": LAMPS}}).head.id
        reader.execute("SELECT * FROM scenes").fetchall()  # holds the log
        sizes = []
        for number in range(count):
            store.scenes.change(scene_id, patch_document({"name": str(number)}), "renamed")
            sizes.append((folder / "store.sqlite3-wal").stat().st_size)
    os.link(folder / "store.sqlite3-wal", folder / "log")
    reader.close()
    return sizes, scene_id


def after_power_cut(tmp_path: Path, scene_id: str, database: bytes, log: bytes) -> str:
    folder = tmp_path / "cut"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "store.sqlite3").write_bytes(database)
    (folder / "store.sqlite3-wal").write_bytes(log)
    with Store(folder, probe=trusting_probe) as store:
        return store.scenes.get(scene_id).document.name


def test_after_a_power_cut_at_any_write_the_last_committed_revision_is_there(tmp_path: Path) -> None:
    data = tmp_path / "data"
    filled(data)
    sizes, scene_id = revisions(data, 12)
    log, choice = (data / "log").read_bytes(), random.Random(3)
    assert len(log) == sizes[-1]
    after = (data / "store.sqlite3").read_bytes()
    for _ in range(30):  # the log was written up to any byte, and the rest of its sector is anything
        cut = choice.randrange(sizes[0], len(log))
        torn: Callable[[], bytes] = choice.choice([bytes, lambda: os.urandom(512)])
        name = after_power_cut(tmp_path, scene_id, after, log[:cut] + torn())
        assert name == str(sum(size <= cut for size in sizes) - 1)
    moved = after_checkpoint(tmp_path, after, log)
    for _ in range(15):  # any of the log's pages were moved into the database
        pages = [
            choice.choice([moved, after.ljust(len(moved), b"\0")])[at : at + 4096]
            for at in range(0, len(moved), 4096)
        ]
        assert after_power_cut(tmp_path, scene_id, b"".join(pages), log) == "11"


def after_checkpoint(tmp_path: Path, database: bytes, log: bytes) -> bytes:
    path = tmp_path / "moved.sqlite3"
    path.write_bytes(database)
    Path(f"{path}-wal").write_bytes(log)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    return path.read_bytes()
