"""REST over a real server: scenes, revisions, objects, parts, and what reaches the render server."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from deltalight.protocol.messages import ControlRequest
from deltalight.services import ports
from deltalight.services.api.render_link import ALIVE_TIMEOUT_S
from tests.services.api_samples import UPLOAD, RenderServer, RunningApi, running_api, sentence
from tests.services.storage_samples import TETRAHEDRON


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory, module_database: str | None) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data"), database=module_database) as running:
        running.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD).raise_for_status()
        yield running


@pytest.fixture
def client(api: RunningApi) -> httpx.Client:
    return api.client


def make(client: httpx.Client, **document: object) -> dict[str, Any]:
    response = client.post("/scenes", json=document)
    assert response.status_code == 201, response.text
    return dict(response.json())


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(1500):
        if condition():
            return
        time.sleep(0.02)
    pytest.fail("it never came")


def test_a_scene_is_made_read_changed_and_deleted(client: httpx.Client) -> None:
    made = client.post("/scenes", json={"name": "room"})
    assert (made.status_code, made.headers["etag"]) == (201, '"1"')
    address = made.headers["location"].removeprefix("/api/v1")
    assert client.get(address).json()["document"]["name"] == "room"
    patched = client.patch(address, json={"output": {"view": "delta"}}, headers={"If-Match": '"1"'})
    assert (patched.json()["revision"], patched.headers["etag"]) == (2, '"2"')
    assert patched.json()["what"] == "output changed"
    stale = client.patch(address, json={"name": "late"}, headers={"If-Match": '"1"'})
    assert "revision 2 and the change was made to 1" in sentence(stale, 409)
    assert stale.json()["revision"] == 2
    assert "revision 2" in sentence(client.put(address, json={"name": "late", "revision": 1}), 409)
    replaced = client.put(address, json={"name": "other", "revision": 2})
    assert replaced.json()["document"]["output"]["view"] == "composite"
    assert client.delete(address).status_code == 204
    assert "no scene" in sentence(client.get(address), 404)


def test_undo_redo_history_and_copies(client: httpx.Client) -> None:
    address = f"/scenes/{make(client, name='one')['id']}"
    assert "nothing to undo" in sentence(client.post(f"{address}/undo"), 409)
    client.patch(address, json={"name": "two"}).raise_for_status()
    undone = client.post(f"{address}/undo").json()
    assert (undone["document"]["name"], undone["can_undo"], undone["can_redo"]) == ("one", False, True)
    assert client.post(f"{address}/redo").json()["document"]["name"] == "two"
    history = client.get(f"{address}/revisions", params={"limit": 3}).json()
    assert [(each["revision"], each["what"]) for each in history] == [
        (4, "redo"),
        (3, "undo"),
        (2, "name changed"),
    ]
    assert client.get(f"{address}/revisions/1").json()["document"]["name"] == "one"
    copy = client.post(f"{address}/duplicate", params={"name": "copy"}).json()
    assert (copy["document"]["name"], copy["revision"]) == ("copy", 1)


def test_an_exported_document_can_be_imported(client: httpx.Client) -> None:
    scene = make(client, name="room", objects=[{"asset": "t.obj", "id": "a"}], output={"tone": "aces"})
    exported = client.get(f"/scenes/{scene['id']}/document")
    assert exported.headers["content-disposition"].startswith("attachment")
    imported = client.post("/scenes", json=exported.json()).json()
    assert imported["id"] != scene["id"]
    assert imported["document"] == scene["document"]


def test_a_document_comes_and_goes_as_yaml(client: httpx.Client) -> None:
    text = "name: straße\nobjects:\n- {id: a, asset: t.obj}\n"
    made = client.post("/scenes", content=text.encode(), headers={"Content-Type": "application/yaml"})
    assert made.status_code == 201, made.text
    address = f"/scenes/{made.json()['id']}/document"
    answer = client.get(address, params={"format": "yaml"})
    assert answer.headers["content-type"].startswith("application/yaml")
    assert answer.headers["content-disposition"].endswith('-1.yaml"')
    assert yaml.safe_load(answer.text) == client.get(address).json() == made.json()["document"]
    again = client.post("/scenes", content=answer.content, headers={"Content-Type": "application/yaml"})
    assert again.json()["document"] == made.json()["document"]


@pytest.mark.parametrize(
    ("content", "media_type", "status", "text"),
    [
        (b"name: [", "application/yaml", 422, "not valid YAML"),
        (b"- a", "application/yaml", 422, "must hold keys and values"),
        (b"&a [*a]", "application/yaml", 422, "not valid YAML"),
        (b"!!python/object/apply:os.system ['id']", "application/yaml", 422, "not valid YAML"),
        (b"\xff\xfe", "application/yaml", 400, "UTF-8"),
        (b"nme: x", "text/yaml", 422, "the nearest known key is `name`"),
        (b"{}", "text/plain", 415, "application/yaml"),
    ],
)
def test_wrong_documents_are_refused(
    client: httpx.Client, content: bytes, media_type: str, status: int, text: str
) -> None:
    answer = client.post("/scenes", content=content, headers={"Content-Type": media_type})
    assert text in sentence(answer, status)


@pytest.mark.parametrize(
    ("path", "patch", "place"),
    [
        ("", {"output": {"width": "640", "height": 480}}, "output.width"),
        ("", {"output": {"antialiasing": 1}}, "output.antialiasing"),
        ("", {"objects": [{"asset": "t.obj", "pose": {"translation_m": [0, True, 0]}}]}, "translation_m[1]"),
        ("/lights/manual/0", {"radiance": "0.5"}, "lights.manual[0].radiance"),
        ("/method", {"bounces": 1.5}, "method.bounces"),
        ("", {"name": 7}, "name"),
        ("", {"revision": -1.0}, "revision"),
    ],
)
def test_json_keeps_its_types(client: httpx.Client, path: str, patch: object, place: str) -> None:
    scene = make(client, lights={"manual": [{"type": "ambient", "radiance": 0.2}]})
    assert place in sentence(client.patch(f"/scenes/{scene['id']}{path}", json=patch), 422)


def test_numbers_are_of_one_kind_whatever_they_look_like(client: httpx.Client) -> None:
    address = f"/scenes/{make(client)['id']}"
    lights = {"manual": [{"type": "ambient", "radiance": 2}]}
    whole = client.patch(address, json={"output": {"width": 640.0, "height": 480}, "lights": lights})
    assert whole.status_code == 200, whole.text
    document = whole.json()["document"]
    assert (document["output"]["width"], document["lights"]["manual"][0]["radiance"]) == (640, 2.0)
    yaml_type = {"Content-Type": "application/yaml"}
    text = "{name: '12e3', lights: {manual: [{type: ambient, radiance: 1e-3}]}}"
    made = client.post("/scenes", content=text, headers=yaml_type).json()
    assert (made["document"]["name"], made["document"]["lights"]["manual"][0]["radiance"]) == ("12e3", 0.001)
    exported = client.get(f"/scenes/{made['id']}/document", params={"format": "yaml"}).content
    assert client.post("/scenes", content=exported, headers=yaml_type).json()["document"] == made["document"]
    assert "name" in sentence(client.post("/scenes", content="name: 12e3", headers=yaml_type), 422)


def test_manual_lights_one_by_one(client: httpx.Client) -> None:
    scene = make(client, lights={"manual": [{"type": "ambient", "radiance": 0.2}]})
    address = f"/scenes/{scene['id']}/lights/manual"
    lamp = {"type": "sphere", "position_m": [0, 0, 1], "intensity": 2}
    added = client.post(address, json=lamp)
    assert (added.status_code, added.json()["what"]) == (201, "sphere light added")
    assert [light["type"] for light in client.get(address).json()] == ["ambient", "sphere"]
    stale = client.patch(f"{address}/1", json={"intensity": 3}, headers={"If-Match": '"1"'})
    assert "revision 2" in sentence(stale, 409)
    client.patch(f"{address}/1", json={"intensity": 3}).raise_for_status()
    one = client.get(f"{address}/1")
    assert (one.json()["intensity"], one.json()["position_m"], one.headers["etag"]) == (3, [0, 0, 1], '"3"')
    assert "lights.manual[1].intensity" in sentence(client.patch(f"{address}/1", json={"intensity": -1}), 422)
    spot = client.patch(f"{address}/1", json={"type": "spot"})
    assert spot.status_code == 200, spot.text
    assert client.get(f"{address}/1").json()["position_m"] == [0, 0, 1]
    even = client.patch(f"{address}/1", json={"type": "ambient"})
    assert even.status_code == 200, even.text
    assert "unknown kind `lamp`" in sentence(client.patch(f"{address}/1", json={"type": "lamp"}), 422)
    assert "lights.manual[1]" in sentence(client.patch(f"{address}/1", json={"type": ["spot"]}), 422)
    client.put(f"{address}/1", json={"type": "directional", "direction": [0, 0, -1]}).raise_for_status()
    assert client.delete(f"{address}/0").status_code == 200
    assert [light["type"] for light in client.get(address).json()] == ["directional"]
    for method in ("GET", "DELETE", "PUT", "PATCH"):
        answer = client.request(method, f"{address}/1", json=None if method == "GET" else lamp)
        assert "has 1 manual light," in sentence(answer, 404)


def test_changes_of_a_gesture_are_undone_together(client: httpx.Client) -> None:
    address = f"/scenes/{make(client, objects=[{'id': 'a', 'asset': 't.obj'}])['id']}"
    for x in (0.1, 0.2, 0.3):
        moved = client.patch(
            f"{address}/objects/a",
            json={"pose": {"translation_m": [x, 0, 0]}},
            headers={"Deltalight-Gesture": "drag-1"},
        )
        assert moved.status_code == 200, moved.text
    undone = client.post(f"{address}/undo").json()
    assert undone["document"]["objects"][0]["pose"]["translation_m"] == [0, 0, 0]
    assert not undone["can_undo"]
    assert client.get(f"{address}/revisions").json()[1]["gesture"] == "drag-1"
    wrong = client.patch(address, json={"name": "x"}, headers={"Deltalight-Gesture": "a b"})
    assert "Deltalight-Gesture" in sentence(wrong, 400)


def test_objects_by_id(client: httpx.Client) -> None:
    address = f"/scenes/{make(client)['id']}/objects"
    added = client.post(address, json={"asset": "t.obj", "id": "shelf/left cup"})
    assert (added.status_code, added.json()["revision"]) == (201, 2)
    assert added.json()["what"] == "shelf/left cup added"
    cup = f"{address}/shelf%2Fleft%20cup"
    moved = client.patch(cup, json={"pose": {"translation_m": [0, 0, 0.1]}}, headers={"If-Match": '"2"'})
    assert moved.json()["what"] == "shelf/left cup: pose changed"
    coloured = client.patch(cup, json={"material": {"roughness": 0.2}})
    assert coloured.json()["document"]["objects"][0]["pose"]["translation_m"] == [0, 0, 0.1]
    assert client.get(cup).json()["material"]["roughness"] == 0.2
    assert client.put(cup, json={"asset": "t.obj"}).json()["document"]["objects"][0]["material"] is None
    taken = client.post(address, json={"asset": "t.obj", "id": "shelf/left cup"})
    assert "two objects have the id" in sentence(taken, 422)
    assert client.delete(cup).status_code == 200
    assert "no object `shelf/left cup`" in sentence(client.get(cup), 404)
    assert "no object" in sentence(client.patch(cup, json={}), 404)


@pytest.mark.parametrize(
    ("part", "value", "patch", "expected"),
    [
        ("method", {"name": "dvct", "bounces": 3}, {"cone_count": 8}, {"bounces": 3, "cone_count": 8}),
        ("method", {"name": "dvct", "bounces": 3}, {"name": "none"}, {"name": "none"}),
        ("output", {"view": "delta"}, {"tone": "aces"}, {"view": "delta", "tone": "aces"}),
        ("lights", {"manual": []}, {"registration": "auto"}, {"manual": [], "registration": "auto"}),
        ("real", {"geometry": "fused"}, {"geometry": None}, {"geometry": "depth"}),
        ("shading", {}, {"name": "volume"}, {"name": "volume"}),
    ],
)
def test_parts_are_replaced_and_patched(
    client: httpx.Client, part: str, value: object, patch: object, expected: dict[str, object]
) -> None:
    address = f"/scenes/{make(client, name='kept')['id']}"
    client.put(f"{address}/{part}", json=value).raise_for_status()
    answer = client.patch(f"{address}/{part}", json=patch)
    assert expected.items() <= answer.json()["document"][part].items()
    assert answer.json()["document"]["name"] == "kept"
    got = client.get(f"{address}/{part}")
    assert expected.items() <= got.json().items()
    assert got.headers["etag"] == answer.headers["etag"]


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "expected"),
    [
        ("PATCH", "", {"metod": {}}, 422, "unknown key `metod`; the nearest known key is `method`"),
        ("PATCH", "", {"objects": [{"asset": "t.obj", "pose": {"scale": -1}}]}, 422, "objects[0].pose.scale"),
        ("PATCH", "", {"objects": [{"asset": "/etc/passwd"}]}, 422, "not an uploaded asset"),
        ("PATCH", "", {"objects": [{"asset": "../../store.sqlite3"}]}, 422, "not an uploaded asset"),
        ("PATCH", "", {"lights": {"environment": {"map": "t.obj"}}}, 422, "needs a map"),
        ("PATCH", "", [1, 2], 422, "`body` is wrong"),
        ("PUT", "", [1, 2], 422, "the scene"),
        ("PUT", "/method", {"name": "dvctt"}, 422, "the nearest is `dvct`"),
        ("PUT", "/method", "fast", 422, "the scene"),
        ("PUT", "/output", {"width": 1e300}, 422, "output.width"),
        ("POST", "/objects", {}, 422, "`objects[0].asset` is missing"),
        ("POST", "/objects", None, 422, "The body is missing; send one, as JSON."),
        ("PATCH", "/output", [], 422, "`body` is wrong: must be an object with keys and values"),
        ("POST", "/objects", 7, 422, "`objects[0]` is wrong"),
        ("GET", "/revisions?limit=0", None, 422, "limit"),
        ("GET", "/revisions/9", None, 404, "no revision 9"),
        ("GET", "/nothing", None, 404, "Not Found"),
        ("POST", "", None, 405, "Method Not Allowed"),
    ],
)
def test_wrong_requests_are_one_sentence(
    *, client: httpx.Client, method: str, path: str, body: object, status: int, expected: str
) -> None:
    scene = make(client)
    response = client.request(method, f"/scenes/{scene['id']}{path}", json=body)
    assert expected in sentence(response, status)
    assert client.get(f"/scenes/{scene['id']}").json()["revision"] == 1


@pytest.mark.parametrize(
    ("content", "status"),
    [
        (b"{", 400),
        (b"\xff\xfe", 400),
        (b"[" * 100_000, 400),
        (b'{"name": NaN}', 422),
        (b'{"output": {"width": NaN}}', 422),
        (b'{"name": "\\ud800"}', 422),
        (b'{"\\ud800": 1}', 422),
        (b'{"a": ' * 900 + b"1" + b"}" * 900, 422),
        (b'{"output": {"width": 1' + b"0" * 4000 + b"}}", 422),
        (b"", 422),
    ],
)
def test_malformed_bodies_never_break_it(client: httpx.Client, content: bytes, status: int) -> None:
    address = f"/scenes/{make(client)['id']}"
    json_type = {"Content-Type": "application/json"}
    assert sentence(client.patch(address, content=content, headers=json_type), status)
    assert sentence(client.post("/scenes", content=content, headers=json_type), status)


def test_merge_patch_has_its_own_media_type_and_forms_are_refused(client: httpx.Client) -> None:
    address = f"/scenes/{make(client)['id']}"
    patch = {"Content-Type": "application/merge-patch+json"}
    assert client.patch(address, content=b'{"name": "a"}', headers=patch).json()["revision"] == 2
    for simple in ("text/plain", "application/x-www-form-urlencoded"):  # what pages of other sites may send
        for send in (client.patch, client.put):  # a patch is a dictionary, a document has a model
            refused = send(address, content=b'{"name": "b"}', headers={"Content-Type": simple})
            assert "with Content-Type: application/json" in sentence(refused, 422)
    assert client.get(address).json()["revision"] == 2


def test_wrong_if_match_is_refused(client: httpx.Client) -> None:
    address = f"/scenes/{make(client)['id']}"
    assert "in quotes" in sentence(client.patch(address, json={}, headers={"If-Match": "new"}), 400)
    assert client.patch(address, json={"name": "x"}, headers={"If-Match": "*"}).json()["revision"] == 2


def test_a_server_that_never_answered_is_silent_from_the_first_request_on(tmp_path: Path) -> None:
    with running_api(tmp_path) as api:
        assert api.client.get("/health").json()["render_server"] == "silent"
        scene = make(api.client)
        answer = api.client.post(f"/scenes/{scene['id']}/activate").json()
        assert answer["picture"]["state"] == "pending"


def test_a_change_reaches_the_render_server_before_its_answer(api: RunningApi) -> None:
    client = api.client
    wait_for(lambda: client.get("/state").json()["render_server"] == "silent")
    server = RenderServer(api.control_port)
    scene = make(client, name="shown", objects=[{"asset": "t.obj", "id": "a"}])
    address = f"/scenes/{scene['id']}"
    wait_for(lambda: client.get("/state").json()["render_server"] == "answers")
    assert client.post(f"{address}/activate").json()["picture"] == {
        "state": "shown",
        "revision": 1,
        "detail": "",
    }
    assert (server.session.scene_id, server.session.scene.revision) == (scene["id"], 1)
    for revision in (2, 3):
        answer = client.patch(address, json={"name": f"change {revision}"}).json()
        assert answer["picture"] == {"state": "shown", "revision": revision, "detail": ""}
        assert server.session.scene.name == f"change {revision}"
    shown = server.session.scene.objects[0].asset
    assert shown.endswith("asset.obj")
    assert client.post(f"{address}/undo").json()["picture"]["state"] == "shown"
    assert server.session.scene.name == "change 2"

    refused = client.patch(address, json={"name": "refused"}).json()
    assert refused["picture"]["state"] == "refused"
    assert "cannot be shown" in refused["picture"]["detail"]
    assert server.session.scene.name == "change 2"

    make(client, name="another")  # it is not active: the server hears nothing of it
    assert server.session.scene.name == "change 2"
    assert "active" in sentence(client.delete(address), 409)
    server.close()

    gone = client.patch(address, json={"name": "while it was away"}).json()
    assert gone["picture"]["state"] == "pending"
    again = RenderServer(api.control_port)  # as started, knows nothing
    wait_for(lambda: again.session.scene.name == "while it was away")
    wait_for(lambda: client.get(address).json()["picture"]["state"] == "shown")
    again.session.execute(_view_request())  # somebody else changes the scene at the server too
    assert client.patch(address, json={"name": "last"}).json()["picture"]["state"] == "shown"
    assert again.session.scene.name == "last"
    again.close()
    wait_for(lambda: client.get("/health").json()["status"] == "degraded")
    assert ALIVE_TIMEOUT_S < 2


def test_a_service_that_begins_shows_its_scene_whatever_the_server_had(tmp_path: Path) -> None:
    (control_port,) = ports.private_ports(1)
    server = RenderServer(control_port)
    control = ports.endpoint(control_port)
    with running_api(tmp_path, control=control) as api:
        scene = make(api.client, name="restored")
        wait_for(lambda: api.client.get("/state").json()["render_server"] == "answers")
        api.client.post(f"/scenes/{scene['id']}/activate").raise_for_status()
    server.session.execute(_ahead(scene["id"]))
    with running_api(tmp_path, control=control) as api:
        wait_for(lambda: server.session.scene.name == "restored")
        answer = api.client.patch(f"/scenes/{scene['id']}", json={"name": "changed"}).json()
        assert answer["picture"] == {"state": "shown", "revision": 2, "detail": ""}
        assert (server.session.scene_id, server.session.scene.revision) == (scene["id"], 2)
    server.close()


def test_requests_and_refusals_are_measured(client: httpx.Client) -> None:
    address = f"/scenes/{make(client)['id']}"
    client.get(address).raise_for_status()
    sentence(client.patch(address, json={"metod": 1}), 422)
    lines = client.get("/metrics").text.splitlines()
    assert any('requests_total{operation="get_scene",status="200"}' in line for line in lines)
    assert any('requests_total{operation="patch_scene",status="422"}' in line for line in lines)
    assert any(line.startswith('deltalight_api_refused_total{kind="invalid"}') for line in lines)
    assert any(line.startswith("deltalight_render_server_answers") for line in lines)
    assert not any(address in line for line in lines)  # each scene of its own would be endless labels


def _ahead(scene_id: str) -> ControlRequest:
    scene = {"name": "ahead"}
    return ControlRequest(
        node="test", id="ahead", op="set_scene", scene_id=scene_id, revision=99, payload={"scene": scene}
    )


def _view_request() -> ControlRequest:
    from tests.services.test_session import request

    return request("set_view", view="delta")
