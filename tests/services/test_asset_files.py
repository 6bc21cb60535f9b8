"""Files of assets in a store of objects: memory's, and one that speaks S3 on loopback."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.faults import NotFoundError, StorageFaultError
from deltalight.services.storage.store import Store
from tests.services.conftest import RunCli
from tests.services.storage_samples import TETRAHEDRON, trusting_probe, upload

fsspec = pytest.importorskip("fsspec", reason="pip install 'deltalight[s3]'")
Open = Callable[[str], Store]


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The address of a server that speaks S3, with the bucket `assets`."""
    server = pytest.importorskip("moto.server", reason="pip install 'moto[s3,server]'").ThreadedMotoServer
    boto3 = pytest.importorskip("boto3")
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running = server(ip_address="127.0.0.1", port=0)
    running.start()
    endpoint = "http://{}:{}".format(*running.get_host_and_port())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", "tests")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "tests")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_ENDPOINT_URL", endpoint)
        boto3.client("s3").create_bucket(Bucket="assets")
        yield endpoint
    running.stop()


@pytest.fixture(params=["memory", "s3"])
def address(request: pytest.FixtureRequest) -> str:
    folder = uuid4().hex
    if request.param == "memory":
        return f"memory://{folder}"
    request.getfixturevalue("s3")
    return f"s3://assets/{folder}"


@pytest.fixture
def open_host(tmp_path: Path, address: str) -> Iterator[Open]:
    """Opens the store of a host by its name: each has a folder of its own, all the database and the files."""
    opened: list[Store] = []
    database = tmp_path / "first" / "store.sqlite3"

    def open_it(name: str) -> Store:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        if folder != database.parent and not (folder / database.name).exists():
            for each in database.parent.glob("store.sqlite3*"):
                (folder / each.name).symlink_to(each)
        opened.append(Store(folder, assets=address, probe=trusting_probe))
        return opened[-1]

    yield open_it
    for store in opened:
        store.close()


def files(address: str) -> list[str]:
    found, root = fsspec.core.url_to_fs(address, skip_instance_cache=True, use_listings_cache=False)
    return [name.removeprefix(root).strip("/") for name in found.find(root)]


def test_what_one_host_stores_another_one_reads_and_removes(open_host: Open, address: str) -> None:
    first = open_host("first")
    asset = upload(first, TETRAHEDRON, "shape.obj")
    assert files(address) == [f"{asset.digest}/asset.obj"]
    second = open_host("second")
    scene = second.scenes.create({"objects": [{"asset": "shape.obj"}]})
    path = Path(second.assets.localised(scene.document).objects[0].asset)
    assert path.is_relative_to(second.folder)
    assert path.read_bytes() == TETRAHEDRON
    path.unlink()  # it is only a copy
    assert second.assets.path(asset).read_bytes() == TETRAHEDRON
    second.scenes.delete(scene.head.id)
    second.assets.remove(asset.digest)
    assert files(address) == []
    with pytest.raises(NotFoundError):
        first.assets.get(asset.digest)
    assert upload(first, TETRAHEDRON, "again.obj").digest == asset.digest
    assert files(address) == [f"{asset.digest}/asset.obj"]


def test_a_damaged_or_lost_file_is_a_sentence_and_leaves_nothing(open_host: Open, address: str) -> None:
    first = open_host("first")
    asset = upload(first, TETRAHEDRON, "shape.obj")
    scene = first.scenes.create({"objects": [{"asset": "shape.obj"}]})
    second = open_host("second")
    objects, root = fsspec.core.url_to_fs(address, skip_instance_cache=True)
    objects.pipe_file(f"{root}/{asset.digest}/asset.obj", TETRAHEDRON[:-1])
    with pytest.raises(StorageFaultError, match="is damaged; upload the asset again"):
        second.assets.localised(scene.document)
    objects.rm_file(f"{root}/{asset.digest}/asset.obj")
    with pytest.raises(StorageFaultError, match=r"shape.obj .* is gone"):
        second.assets.localised(scene.document)
    assert not [path for path in (second.folder / "assets").rglob("*") if path.is_file()]
    assert first.assets.path(asset).read_bytes() == TETRAHEDRON
    upload(first, TETRAHEDRON, "shape.obj")
    assert Path(second.assets.localised(scene.document).objects[0].asset).read_bytes() == TETRAHEDRON


def test_copies_are_as_many_as_a_cache_may_hold(
    open_host: Open, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE_MB", "1")
    store = open_host("first")
    kept = [upload(store, TETRAHEDRON + b"#" * 700_000 + bytes([65 + n]), f"{n}.obj") for n in range(3)]
    folders = [path.name for path in (store.folder / "assets").iterdir() if not path.name.startswith(".")]
    assert folders == [kept[-1].digest]
    assert len(files(address)) == 3
    assert store.assets.path(kept[0]).stat().st_size == kept[0].size_bytes


@pytest.mark.usefixtures("s3")
def test_a_store_that_refuses_is_a_sentence_and_nothing_is_half_stored(tmp_path: Path) -> None:
    with Store(tmp_path, assets="s3://no-such-bucket/x", probe=trusting_probe) as store:
        with pytest.raises(StorageFaultError, match=r"store of assets .* check s3://no-such-bucket/x"):
            upload(store, TETRAHEDRON, "shape.obj")
        assert store.assets.all() == []
        assert not [path for path in (tmp_path / "assets").rglob("*") if path.is_file()]


def test_wrong_addresses_are_sentences(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match="is not the address of an asset store"):
        Store(tmp_path, assets="carrier-pigeon://loft")


def test_backups_are_of_the_data_folder_alone(
    cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("ASSETS", "memory://x"), ("DATABASE", "postgresql://x@/y")):
        with monkeypatch.context() as patch:
            patch.setenv(f"DELTALIGHT_API__{name}", value)
            for command in ("backup", "restore"):
                refused = cli(command, tmp_path / "kept.zip", "--data", tmp_path)
                assert refused.returncode == 2
                assert "pg_dump" in refused.stderr
