"""What `up` shows first, and how its processes are joined."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.services import ports
from deltalight.services.api.serve import make_first_scene
from deltalight.services.api.settings import ApiSettings
from deltalight.services.host import HostPlan
from deltalight.services.host_store import FIRST_SCENE, scene_to_show
from deltalight.services.session_file import session_file
from deltalight.services.storage.store import Store
from tests.services.api_samples import RenderServer
from tests.services.storage_samples import TETRAHEDRON, trusting_probe


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    (tmp_path / "chair.obj").write_bytes(TETRAHEDRON)
    path = tmp_path / "scene.json"
    path.write_text('{"name": "named", "objects": [{"id": "chair", "asset": "chair.obj"}]}')
    return path


def test_the_scene_shown_last_is_shown_again_unless_one_is_named(
    tmp_path: Path, scene_file: Path, database: str | None
) -> None:
    recording = SimpleNamespace(scene=SceneDocument(name="recorded"))
    with Store(tmp_path / "data", database=database, probe=trusting_probe) as store:
        assert scene_to_show(store, recording, None).name == "recorded"
        active = store.scenes.active()
        assert active is not None
        store.scenes.change(active.head.id, lambda document: {**document, "name": "edited"}, "renamed")
        other = SimpleNamespace(scene=SceneDocument(name="another recording"))
        assert scene_to_show(store, other, None).name == "edited"
        named = scene_to_show(store, other, scene_file)
        assert named.name == "named"
        kept = Path(named.objects[0].asset)
        assert kept.read_bytes() == TETRAHEDRON
        assert kept.is_relative_to(tmp_path / "data")
        assert scene_to_show(store, None, None).name == "named"
        assert len(store.scenes.all()) == 2
        with session_file(named) as session:
            assert load_scene(session) == named


def test_without_any_scene_an_empty_one_is_shown(tmp_path: Path) -> None:
    with Store(tmp_path / "data") as store:
        assert scene_to_show(store, None, None).name == FIRST_SCENE
        with pytest.raises(DeltalightError, match="no-such"):
            scene_to_show(store, None, tmp_path / "no-such.json")


def test_the_web_process_hears_server_and_node(tmp_path: Path) -> None:
    def web(source: str | None, remote: str = "") -> tuple[str, ...]:
        plan = HostPlan(source, tmp_path / "session", data=tmp_path, remote_node=remote, page_port=81)
        return plan.specs()[-1].arguments

    here = web("synthetic")
    for endpoint in (ports.endpoint(ports.COMPOSITE_PORT), ports.endpoint(ports.NODE_PORT)):
        assert here[here.index(endpoint) - 1] == "--subscribe"
    assert here[here.index("--port") + 1] == "81"
    assert web(None, "desk")[-4:-2] == ("--node", "desk")
    assert len(HostPlan("synthetic", tmp_path / "session").specs()) == 2


def test_the_processes_meet_at_the_ports_of_their_plan(tmp_path: Path) -> None:
    plan = HostPlan(
        "synthetic",
        tmp_path / "session",
        data=tmp_path,
        node_port=81,
        composite_port=82,
        control_port=83,
        page_port=84,
    )
    node_at, composite_at, control_at = (ports.endpoint(number) for number in (81, 82, 83))
    node, server, web = (options(spec.arguments) for spec in plan.specs())
    assert node["--publish"] == server["--subscribe"] == {node_at}
    assert server["--publish"] == {composite_at}
    assert web["--subscribe"] == {composite_at, node_at}
    assert node["--clock"] == server["--control"] == web["--control"] == {control_at}
    assert web["--port"] == {"84"}


def options(arguments: tuple[str, ...]) -> dict[str, set[str]]:
    """What is given to each option, which may stand there several times."""
    given: dict[str, set[str]] = {}
    for name, value in pairwise(arguments):
        if name.startswith("--"):
            given.setdefault(name, set()).add(value)
    return given


def test_a_service_without_a_scene_takes_over_what_is_shown(tmp_path: Path, scene_file: Path) -> None:
    (port,) = ports.private_ports(1)
    settings = ApiSettings(control=ports.endpoint(port))
    with Store(tmp_path / "silent", probe=trusting_probe) as store:
        make_first_scene(store, settings, None)  # nobody answers
        assert [head.name for head in store.scenes.all()] == [FIRST_SCENE]
    server = RenderServer(port)
    server.session.scene = load_scene(scene_file)
    try:
        with Store(tmp_path / "data", probe=trusting_probe) as store:
            for _ in range(2):
                make_first_scene(store, settings, None)
                active = store.scenes.active()
                assert active is not None
                assert active.document.name == "named"
                assert active.document.objects[0].asset.startswith("sha256:")
            assert len(store.scenes.all()) == 1
        (tmp_path / "chair.obj").unlink()  # the render server is in another container
        with Store(tmp_path / "elsewhere", probe=trusting_probe) as store:
            make_first_scene(store, settings, None)
            assert [head.name for head in store.scenes.all()] == [FIRST_SCENE]
    finally:
        server.close()
