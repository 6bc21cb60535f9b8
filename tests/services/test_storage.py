"""The store: revisions, undo and redo, stale changes, assets in use, tokens."""

import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import create_engine

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_method import DvctMethod, NoneMethod
from deltalight.services.storage.asset_kinds import AssetKind, Facts
from deltalight.services.storage.documents import (
    add_object,
    merge_patch,
    patch_document,
    patch_object,
    patch_part,
    remove_object,
    replace_document,
    replace_object,
)
from deltalight.services.storage.faults import (
    ConflictError,
    NotFoundError,
    RejectedAssetError,
    StaleRevisionError,
    TooLargeError,
)
from deltalight.services.storage.schema import migrate
from deltalight.services.storage.store import Store
from deltalight.services.storage.tables import SCHEMA_VERSION, Base
from deltalight.services.storage.tickets import Ticket
from tests.services.storage_samples import TETRAHEDRON, trusting_probe, upload

DEMO_ASSETS = Path(__file__).parents[2] / "services" / "demo_assets"
TOKEN_OF_VERSION_2 = "deltalight-fa9ac659b290--Bud0XIv_HpLkQqYnqwjfVqalCQgKxd21A1OS9YWbcU"


@pytest.fixture
def store(tmp_path: Path, database: str | None) -> Iterator[Store]:
    with Store(tmp_path / "data", database=database, probe=trusting_probe) as store:
        yield store


def test_the_demos_object_is_stored_without_a_check_and_an_altered_one_is_checked(tmp_path: Path) -> None:
    content = (DEMO_ASSETS / "object.glb").read_bytes()

    def refusing(_path: Path, _kind: AssetKind, name: str) -> Facts:
        raise RejectedAssetError(f"{name} was checked")

    with Store(tmp_path / "data", probe=refusing) as store:
        assert upload(store, content, "object.glb").facts["triangles"] == 8096
        with pytest.raises(RejectedAssetError, match=r"object\.glb was checked"):
            upload(store, content[:-1] + bytes([content[-1] ^ 1]), "object.glb")


def test_every_change_is_a_revision_that_can_be_read_later(store: Store) -> None:
    scene = store.scenes.create({"name": "a"})
    assert scene.document.revision == 1
    changed = store.scenes.change(scene.head.id, patch_document({"name": "b"}), "renamed")
    assert (changed.document.revision, changed.document.name) == (2, "b")
    assert store.scenes.revision(scene.head.id, 1).document.name == "a"
    assert [(each.number, each.what) for each in store.scenes.history(scene.head.id, None, 10)] == [
        (2, "renamed"),
        (1, "created"),
    ]
    assert [each.number for each in store.scenes.history(scene.head.id, 2, 10)] == [1]


def test_a_change_that_changes_nothing_is_no_revision(store: Store) -> None:
    scene = store.scenes.create({"name": "a"})
    assert store.scenes.change(scene.head.id, patch_document({"name": "a"}), "x").document.revision == 1


def test_stale_and_wrong_changes_leave_the_scene_alone(store: Store) -> None:
    scene = store.scenes.create({"name": "a"})
    store.scenes.change(scene.head.id, patch_document({"name": "b"}), "x", expected=1)
    with pytest.raises(StaleRevisionError, match="revision 2 and the change was made to 1") as refusal:
        store.scenes.change(scene.head.id, patch_document({"name": "c"}), "x", expected=1)
    assert refusal.value.current == 2
    with pytest.raises(DeltalightError, match="nearest known key is `method`"):
        store.scenes.change(scene.head.id, patch_document({"metod": {}}), "x")
    assert store.scenes.get(scene.head.id).document.name == "b"


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(st.sampled_from(["change", "undo", "redo"]), max_size=25))
def test_undo_and_redo_walk_as_a_list_of_states_does(store: Store, steps: list[str]) -> None:
    scene_id = store.scenes.create({"name": "0"}).head.id
    past = ["0"]
    future: list[str] = []
    for revision, step in enumerate(steps, start=2):
        if step == "change":
            past.append(str(revision))
            future.clear()
            after = store.scenes.change(scene_id, patch_document({"name": str(revision)}), "x")
        elif (step == "undo" and len(past) == 1) or (step == "redo" and not future):
            with pytest.raises(ConflictError):
                getattr(store.scenes, step)(scene_id)
            return
        else:
            past, future = (
                (past[:-1], [*future, past[-1]]) if step == "undo" else ([*past, future[-1]], future[:-1])
            )
            after = getattr(store.scenes, step)(scene_id)
        assert (after.document.name, after.document.revision) == (past[-1], revision)
        assert (after.can_undo, after.can_redo) == (len(past) > 1, bool(future))


def test_one_undo_takes_a_whole_gesture_back(store: Store) -> None:
    scene_id = store.scenes.create({"name": "start"}).head.id

    def rename(name: str, gesture: str | None = None) -> None:
        store.scenes.change(scene_id, patch_document({"name": name}), f"to {name}", None, gesture)

    rename("a")
    for name in ("b", "c", "d"):
        rename(name, "drag-1")
    for name in ("e", "f"):
        rename(name, "drag-2")
    rename("g")
    undone = [store.scenes.undo(scene_id).document.name for _ in range(4)]
    assert undone == ["f", "d", "a", "start"]
    redone = [store.scenes.redo(scene_id).document.name for _ in range(4)]
    assert redone == ["a", "d", "f", "g"]
    history = store.scenes.history(scene_id, 9, 50)
    assert [each.gesture for each in history] == [None, "drag-2", "drag-2", *["drag-1"] * 3, None, None]
    store.scenes.undo(scene_id)
    rename("h", "drag-2")
    assert store.scenes.undo(scene_id).document.name == "f", "after an undo a gesture begins anew"


def test_changes_of_many_threads_all_arrive(store: Store) -> None:
    scene_id = store.scenes.create({}).head.id
    asset = upload(store, TETRAHEDRON, "t.obj").reference
    with ThreadPoolExecutor(8) as pool:
        list(
            pool.map(lambda _: store.scenes.change(scene_id, add_object({"asset": asset}), "add"), range(40))
        )
    scene = store.scenes.get(scene_id)
    assert scene.document.revision == 41
    assert len({item.id for item in scene.document.objects}) == 40


def test_of_two_changes_to_one_revision_one_is_stale(store: Store) -> None:
    scene_id = store.scenes.create({}).head.id

    def attempt(name: str) -> bool:
        try:
            store.scenes.change(scene_id, patch_document({"name": name}), "x", expected=1)
        except StaleRevisionError:
            return False
        return True

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(attempt, "abcd")) == 1


def test_scenes_are_copied_listed_and_deleted(store: Store) -> None:
    first = store.scenes.create({"name": "room", "output": {"tone": "aces"}})
    copy = store.scenes.duplicate(first.head.id)
    assert (copy.document.name, copy.document.output.tone) == ("room (copy)", "aces")
    assert copy.document.revision == 1
    store.scenes.activate(first.head.id)
    assert [(head.name, head.is_active) for head in store.scenes.all()] == [
        ("room", True),
        ("room (copy)", False),
    ]
    with pytest.raises(ConflictError, match="active"):
        store.scenes.delete(first.head.id)
    store.scenes.delete(copy.head.id)
    assert [head.id for head in store.scenes.all()] == [first.head.id]
    with pytest.raises(NotFoundError):
        store.scenes.get(copy.head.id)


def test_a_copy_of_a_scene_without_a_name_is_named_without_a_space(store: Store) -> None:
    assert store.scenes.duplicate(store.scenes.create({}).head.id).document.name == "(copy)"


def test_everything_is_there_after_reopening(tmp_path: Path, database: str | None) -> None:
    with Store(tmp_path, database=database, probe=trusting_probe) as store:
        scene_id = store.scenes.create({"name": "kept"}).head.id
        store.scenes.activate(scene_id)
        digest = upload(store, TETRAHEDRON, "t.obj").digest
    with Store(tmp_path, database=database, probe=trusting_probe) as store:
        active = store.scenes.active()
        assert active is not None
        assert active.document.name == "kept"
        assert store.assets.path(store.assets.get(digest)).read_bytes() == TETRAHEDRON


def test_assets_are_named_by_digest_or_name_and_nothing_else(store: Store) -> None:
    asset = upload(store, TETRAHEDRON, "folder/../shape.obj")
    assert asset.names == ("shape.obj",)
    scene = store.scenes.create({"objects": [{"asset": "shape.obj"}]})
    assert scene.document.objects[0].asset == asset.reference
    for path in (
        "/etc/passwd",
        "../shape.obj",
        "./shape.obj",
        str(store.assets.path(asset)),
        "sha256:",
        "sha256:../x",
    ):
        with pytest.raises(DeltalightError, match=r"objects\[0\].asset"):
            store.scenes.create({"objects": [{"asset": path}]})
    with pytest.raises(DeltalightError, match="needs a map"):
        store.scenes.change(
            scene.head.id, patch_part("lights", {"environment": {"map": "shape.obj"}}), "light"
        )
    upload(store, TETRAHEDRON + b"# another\n", "shape.obj")
    with pytest.raises(DeltalightError, match="several assets"):
        store.scenes.create({"objects": [{"asset": "shape.obj"}]})


def test_the_render_server_gets_files_and_clients_get_no_paths(store: Store) -> None:
    asset = upload(store, TETRAHEDRON, "shape.obj")
    scene = store.scenes.create({"objects": [{"asset": "shape.obj"}]})
    path = store.assets.localised(scene.document).objects[0].asset
    assert Path(path).read_bytes() == TETRAHEDRON
    assert Path(path).is_absolute()
    sentence = store.assets.without_paths(f"{path} has no triangle")
    assert sentence == f"sha256:{asset.digest}/asset.obj has no triangle"


def test_an_asset_in_use_stays(store: Store) -> None:
    asset = upload(store, TETRAHEDRON, "shape.obj")
    scene = store.scenes.create({"objects": [{"asset": "shape.obj", "id": "a"}]})
    store.scenes.change(scene.head.id, remove_object("a"), "removed")
    with pytest.raises(ConflictError, match="used by scene"):
        store.assets.remove(asset.digest)  # undo would need it
    assert store.scenes.undo(scene.head.id).document.objects[0].asset == asset.reference
    store.scenes.delete(scene.head.id)
    store.assets.remove(asset.digest)
    assert not store.assets.path(asset).parent.exists()
    with pytest.raises(NotFoundError):
        store.assets.get(asset.digest)
    assert upload(store, TETRAHEDRON, "shape.obj").digest == asset.digest


def test_the_same_content_is_kept_once_under_both_names(store: Store) -> None:
    first, second = (upload(store, TETRAHEDRON, name) for name in ("a.obj", "b.obj"))
    assert first.digest == second.digest
    assert second.names == ("a.obj", "b.obj")
    assert len(store.assets.all()) == 1


@pytest.mark.parametrize(
    ("content", "name", "sentence"),
    [
        (b"MZ\x90\x00 program", "chair.glb", r"not in a known format; upload one of GLB, .*, or a ZIP"),
        (b'{"asset": {"version": "2.0"}}', "chair.gltf", "pack them in a .zip"),
        (TETRAHEDRON, "chair.ply", "is a OBJ file and not PLY"),
        (b"", "chair.obj", "not in a known format"),
        (TETRAHEDRON, "..", "needs the file's own name"),
        (TETRAHEDRON, "sha256:00", "needs the file's own name"),
    ],
)
def test_wrong_files_are_refused_and_leave_nothing(
    store: Store, tmp_path: Path, content: bytes, name: str, sentence: str
) -> None:
    with pytest.raises(RejectedAssetError, match=sentence):
        upload(store, content, name)
    assert store.assets.all() == []
    assert [path for path in (tmp_path / "data" / "assets").rglob("*") if path.is_file()] == []


def test_too_much_is_refused_while_it_arrives(store: Store) -> None:
    with store.assets.receiving(1 << 20) as incoming:
        incoming.write(bytes(600_000))
        with pytest.raises(TooLargeError, match="larger than 1 MB"):
            incoming.write(bytes(600_000))


def test_objects_are_edited_by_id(store: Store) -> None:
    upload(store, TETRAHEDRON, "t.obj")
    scene_id = store.scenes.create({"objects": [{"id": "object1", "asset": "t.obj"}]}).head.id
    edits = [
        add_object({"asset": "t.obj"}),
        patch_object("object0", {"pose": {"scale": 2.0}}),
        patch_object("object0", {"pose": {"translation_m": [0, 0, 1]}}),
        replace_object("object1", {"asset": "t.obj", "visible": False}),
    ]
    for edit in edits:
        scene = store.scenes.change(scene_id, edit, "edit")
    kept, added = scene.document.objects
    assert (kept.id, kept.visible) == ("object1", False)
    assert (added.id, added.pose.scale, added.pose.translation_m) == ("object0", 2.0, (0, 0, 1))
    with pytest.raises(NotFoundError, match="no object `chair`"):
        store.scenes.change(scene_id, patch_object("chair", {}), "edit")


def test_another_method_begins_with_its_defaults(store: Store) -> None:
    scene_id = store.scenes.create({"method": {"name": "dvct", "bounces": 3}}).head.id
    kept = store.scenes.change(scene_id, patch_document({"method": {"cone_count": 8}}), "x")
    assert isinstance(kept.document.method, DvctMethod)
    assert (kept.document.method.bounces, kept.document.method.cone_count) == (3, 8)
    other = store.scenes.change(scene_id, patch_part("method", {"name": "none"}), "x")
    assert isinstance(other.document.method, NoneMethod)


def test_a_patch_to_another_kind_of_material_replaces_it() -> None:
    numbers, asset = {"base_color": [1, 0, 0], "roughness": 0.5}, {"precomputed": "sha256:00"}
    for old, new in ((numbers, asset), (asset, numbers)):
        document = {"objects": [{"id": "a", "material": old}]}
        assert patch_object("a", {"material": new})(document)["objects"][0]["material"] == new
    rough = patch_object("a", {"material": {"roughness": 1}})({"objects": [{"id": "a", "material": numbers}]})
    assert rough["objects"][0]["material"] == {**numbers, "roughness": 1}


def test_merge_patch_does_what_its_standard_says() -> None:
    # The example of RFC 7396, section 3, and cases of its appendix A.
    target = {"title": "Goodbye!", "author": {"givenName": "John", "familyName": "Doe"}, "tags": ["a", "b"]}
    patch = {"title": "Hello!", "author": {"familyName": None}, "tags": ["a"], "phone": "1"}
    assert merge_patch(target, patch) == {
        "title": "Hello!",
        "author": {"givenName": "John"},
        "tags": ["a"],
        "phone": "1",
    }
    assert merge_patch({"a": "b"}, ["c"]) == ["c"]
    assert merge_patch([1, 2], {"a": "b", "c": None}) == {"a": "b"}
    assert merge_patch({}, {"a": {"bb": {"ccc": None}}}) == {"a": {"bb": {}}}
    deep: dict[str, object] = {}
    for _ in range(5000):
        deep = {"a": deep}
    with pytest.raises(DeltalightError, match="nested too deeply"):
        merge_patch({}, deep)


@pytest.mark.parametrize("document", [None, [], "scene", 7, {"objects": {}}, {"objects": [None]}])
def test_what_is_no_document_is_a_sentence(store: Store, document: object) -> None:
    with pytest.raises(DeltalightError, match="the scene"):
        store.scenes.create(document)
    scene_id = store.scenes.create({}).head.id
    with pytest.raises(DeltalightError, match="the scene"):
        store.scenes.change(scene_id, replace_document(document), "x")


def test_tokens_are_shown_once_and_kept_as_hashes(store: Store, tmp_path: Path, database: str | None) -> None:
    token = store.tokens.create("wall", "view")
    found = store.tokens.verify(token)
    assert found is not None
    assert (found.name, found.role) == ("wall", "view")
    assert store.tokens.verify(token[:-1] + ("A" if token[-1] != "A" else "B")) is None
    assert store.tokens.verify("guess") is None
    secret = token.split("-", 2)[2].encode()
    assert all(secret not in path.read_bytes() for path in (tmp_path / "data").iterdir() if path.is_file())
    with pytest.raises(ConflictError):
        store.tokens.create("wall", "control")
    with Store(tmp_path / "data", database=database, probe=trusting_probe) as elsewhere:
        elsewhere.tokens.revoke("wall")
    assert store.tokens.verify(token) is None
    assert store.tokens.is_empty


def test_a_store_of_the_version_before_is_opened_and_goes_on(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "store.sqlite3") as connection:
        connection.executescript(Path(__file__).with_name("store_version_1.sql").read_text())
    connection.close()
    for _ in range(2):  # the second time there is nothing to bring up to date
        with Store(tmp_path) as store:
            active = store.scenes.active()
            assert active is not None
            assert active.document.name == "new"
            assert [each.gesture for each in store.scenes.history(active.head.id, None, 9)][-2:] == [
                None,
                None,
            ]
            for name in ("x", "y"):
                store.scenes.change(active.head.id, patch_document({"name": name}), "", None, "drag")
            assert store.scenes.undo(active.head.id).document.name == "new"
    with Store(tmp_path) as store:
        active = store.scenes.active()
        assert active is not None
        assert store.scenes.undo(active.head.id).document.name == "old"


def test_a_store_that_knew_no_tickets_keeps_all_it_has(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "store.sqlite3") as connection:
        connection.executescript(Path(__file__).with_name("store_version_2.sql").read_text())
    connection.close()
    for _ in range(2):
        with Store(tmp_path) as store:
            active = store.scenes.active()
            assert active is not None
            assert (active.document.name, active.document.revision, active.can_redo) == ("first", 4, True)
            (asset,) = store.assets.all()
            assert (asset.names, active.document.objects[0].asset) == (("shape.obj",), asset.reference)
            token = store.tokens.verify(TOKEN_OF_VERSION_2)
            assert token is not None
            assert token.name == "wall"
    with Store(tmp_path) as store:
        active = store.scenes.active()
        assert active is not None
        assert store.scenes.redo(active.head.id).document.name == "third"
        store.tickets.add("secret", Ticket("view", None, ""), 30.0)
        assert store.tickets.take("secret") == Ticket("view", None, "")
        assert store.tickets.take("secret") is None


def test_migrations_from_nothing_make_the_tables_that_a_new_store_has(database: str | None) -> None:
    engine = create_engine((database or "sqlite://").replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        migrate(connection)
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []
        assert context.get_current_revision() == str(SCHEMA_VERSION)
    engine.dispose()


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    Store(tmp_path).close()
    with sqlite3.connect(tmp_path / "store.sqlite3") as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()
    with pytest.raises(DeltalightError, match="another version of Deltalight"):
        Store(tmp_path)


def test_a_file_that_is_no_database_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "store.sqlite3").write_bytes(b"not a database at all" * 100)
    with pytest.raises(DeltalightError, match=r"store.sqlite3 is damaged .*deltalight restore BACKUP"):
        Store(tmp_path)
