"""HEAD wherever GET is: the same head, no body, the same rights, and no stream that begins."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from deltalight.services.api.live_hub import LiveHub
from tests.services.api_samples import RunningApi, running_api
from tests.services.record_samples import frames, write
from tests.services.storage_samples import TETRAHEDRON, upload

CHANGING = {"date", "content-length"}  # where the answers hold times


def root(api: RunningApi) -> str:
    return str(api.client.base_url).removesuffix("/api/v1/")


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    """With a scene, an asset and a recording."""
    folder = tmp_path_factory.mktemp("data")
    with running_api(folder, subscribe=[]) as running:
        running.client.post("/scenes", json={"name": "kept", "objects": []}).raise_for_status()
        upload(running.store, TETRAHEDRON, "t.obj")
        write(folder / "recordings" / "take.mcap", frames(3))
        yield running


@pytest.fixture(scope="module")
def addresses(api: RunningApi) -> list[str]:
    """Every address of GET that the API's description names, of what there is."""
    scene = api.client.get("/scenes").json()[0]["id"]
    digest = api.client.get("/assets").json()[0]["asset"].removeprefix("sha256:")
    known = {"{scene_id}": scene, "{digest}": digest, "{recording_id}": "take", "{revision}": "1"}
    description = api.client.get(f"{root(api)}/openapi.json").json()
    found = []
    for path, operations in description["paths"].items():
        assert "head" not in operations
        address = path.removeprefix("/api/v1")
        for name, value in known.items():
            address = address.replace(name, value)
        if "get" in operations and address != "/cameras":  # each request of which starts a process
            found.append(address)
    return found


def test_head_of_every_address_is_the_head_of_get(api: RunningApi, addresses: list[str]) -> None:
    assert len(addresses) > 30
    assert sum(api.client.head(address).is_success for address in addresses) > 20
    for address in addresses:
        got, head = api.client.get(address), api.client.head(address)
        assert (address, head.status_code, head.content) == (address, got.status_code, b"")
        for name in {*got.headers, *head.headers} - CHANGING:
            assert (address, name, head.headers.get(name)) == (address, name, got.headers.get(name))


def test_head_tells_the_length_of_what_get_returns(api: RunningApi, addresses: list[str]) -> None:
    named = [each for each in addresses if each.endswith(("/scenes", "/content", "/poster.jpg", "take"))]
    assert len(named) >= 4
    for address in named:
        got, head = api.client.get(address), api.client.head(address)
        assert (address, head.headers["content-length"]) == (address, got.headers["content-length"])


def test_head_ignores_ranges(api: RunningApi, addresses: list[str]) -> None:
    (content,) = (each for each in addresses if each == "/recordings/take/content")
    size = api.client.get(content).headers["content-length"]
    ranged = api.client.head(content, headers={"Range": "bytes=0-9"})
    assert (ranged.status_code, ranged.headers["content-length"]) == (200, size)
    assert api.client.get(content, headers={"Range": "bytes=0-9"}).status_code == 206


def test_head_tells_the_revision(api: RunningApi) -> None:
    (scene, *_) = api.client.get("/scenes").json()
    head = api.client.head(f"/scenes/{scene['id']}")
    assert head.headers["etag"] == api.client.get(f"/scenes/{scene['id']}").headers["etag"]


def test_head_starts_no_stream(api: RunningApi, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[object] = []
    monkeypatch.setattr(LiveHub, "viewer", lambda *_arguments, **_named: begun.append(1))
    head = api.client.head("/live.mjpg")
    assert (head.status_code, head.content, begun) == (200, b"", [])
    assert head.headers["content-type"].startswith("multipart/x-mixed-replace")
    assert api.client.head("/live.mjpg", params={"camera": "nobody"}).status_code == 404
    assert api.client.get("/health").is_success  # over the same connection


def test_head_is_refused_where_there_is_no_get_or_nothing(api: RunningApi) -> None:
    for address, status in (("/live/pick", 405), ("/tickets", 405), ("/nowhere", 404), ("/scenes/none", 404)):
        head = api.client.head(address)
        assert (address, head.status_code, head.content) == (address, status, b"")
        assert head.headers["content-type"] == "application/problem+json"


def test_the_page_and_the_description_answer_head(api: RunningApi) -> None:
    for address in (f"{root(api)}/", f"{root(api)}/openapi.json"):
        got, head = api.client.get(address), api.client.head(address)
        assert (head.status_code, head.content) == (got.status_code, b"")


def test_head_needs_the_rights_of_get(tmp_path: Path) -> None:
    with running_api(tmp_path, host="0.0.0.0") as guarded:
        token = {"Authorization": f"Bearer {guarded.store.tokens.create('watcher', 'view')}"}
        assert guarded.client.head("/scenes").status_code == 401
        assert guarded.client.head("/scenes", headers=token).status_code == 200
        assert guarded.client.head("/health").status_code == 200
        ticket = guarded.client.post("/tickets", headers=token).json()["ticket"]
        assert guarded.client.head("/scenes", params={"ticket": ticket}).status_code == 200
        assert guarded.client.head("/scenes", params={"ticket": ticket}).status_code == 401


def test_head_is_measured_as_the_route(api: RunningApi) -> None:
    def counted() -> float:
        lines = api.client.get("/metrics").text.splitlines()
        named = 'deltalight_api_requests_total{operation="list_scenes",status="200"} '
        return sum(float(line.removeprefix(named)) for line in lines if line.startswith(named))

    before = counted()
    assert api.client.head("/scenes").is_success
    assert counted() == before + 1


def test_a_web_process_without_jobs_answers_head(tmp_path: Path) -> None:
    with running_api(tmp_path, jobs=False) as other:
        assert other.client.head("/recordings").status_code == 200


def test_what_an_address_does_not_support_is_answered_by_what_it_does(api: RunningApi) -> None:
    (scene,) = (each["id"] for each in api.client.get("/scenes").json() if each["name"] == "kept")
    for address, methods in (
        ("/scenes", "GET, HEAD, POST"),
        (f"/scenes/{scene}", "DELETE, GET, HEAD, PATCH, PUT"),
        (f"/scenes/{scene}/undo", "POST"),
    ):
        for method in ("OPTIONS", "TRACE"):
            answer = api.client.request(method, address)
            assert (answer.status_code, answer.headers["allow"]) == (405, methods)


def test_a_range_of_something_else_than_bytes_is_ignored(api: RunningApi) -> None:
    whole = api.client.get("/recordings/take/content")
    for unit in ("lines=1-2", "frames=0-"):
        answer = api.client.get("/recordings/take/content", headers={"Range": unit})
        assert (answer.status_code, answer.content) == (200, whole.content)
