"""Who may do what: loopback, tokens and roles, other sites' pages, rates, sizes."""

import gc
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from sqlalchemy import update
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.services.api import connections
from deltalight.services.api.auth import ADDRESSES_OF_TOKEN, WRONG_TOKENS_AT_ONCE
from deltalight.services.api.credentials import SecretToken
from deltalight.services.api.limits import REMEMBERED_CLIENTS, RateLimit
from deltalight.services.api.settings import ApiSettings
from deltalight.services.storage.tables import TokenRow
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.storage_samples import TETRAHEDRON, upload


@pytest.fixture(scope="module")
def default_api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture
def open_api(default_api: RunningApi) -> Iterator[RunningApi]:
    """As it is by default, on loopback; without scenes."""
    yield default_api
    for scene in default_api.store.scenes.all():
        default_api.store.scenes.delete(scene.id)


@pytest.fixture
def guarded(tmp_path_factory: pytest.TempPathFactory, database: str | None) -> Iterator[RunningApi]:
    """With the rules of an address that leaves the host (the test itself listens on loopback)."""
    with running_api(tmp_path_factory.mktemp("data"), host="0.0.0.0", database=database) as running:
        yield running


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


@pytest.mark.parametrize(
    ("host", "leaves"),
    [("127.0.0.1", False), ("127.8.8.8", False), ("::1", False), ("localhost", False), ("0.0.0.0", True)],
)
def test_which_addresses_leave_the_host(host: str, leaves: bool) -> None:
    assert ApiSettings(host=host).leaves_host is leaves


def test_loopback_needs_no_token_but_refuses_a_wrong_one(open_api: RunningApi) -> None:
    client = open_api.client
    assert client.get("/scenes").json() == []
    assert "is unknown" in sentence(client.get("/scenes", headers=bearer("guess")), 401)
    assert client.get("/settings").json()["needs_token"] is False


def test_elsewhere_every_request_needs_a_token(guarded: RunningApi) -> None:
    client = guarded.client
    for method, path in (("GET", "/scenes"), ("POST", "/scenes"), ("GET", "/state"), ("GET", "/nothing")):
        answer = client.request(method, path)
        assert "token is needed" in sentence(answer, 401)
        assert answer.headers["www-authenticate"] == "Bearer"
    assert client.get("/health").status_code == 200
    token = guarded.store.tokens.create("me", "control")
    assert client.post("/scenes", json={}, headers=bearer(token)).status_code == 201
    assert "token is needed" in sentence(client.get("/scenes", headers={"Cookie": f"token={token}"}), 401)
    assert client.get(f"/scenes?token={token}").status_code == 401
    guarded.store.tokens.revoke("me")
    assert "is unknown" in sentence(client.get("/scenes", headers=bearer(token)), 401)


def test_a_token_that_an_earlier_version_stored_is_told_to_be_made_again(guarded: RunningApi) -> None:
    token = guarded.store.tokens.create("old", "control")
    with guarded.store.tokens._database.writing() as session:
        session.execute(update(TokenRow).values(hash=b"\0" * 64))  # the length of a scrypt hash
    answer = guarded.client.get("/scenes", headers=bearer(token))
    assert "earlier version; revoke it" in sentence(answer, 401)


def test_no_log_line_holds_a_token_or_ticket(guarded: RunningApi, capfd: pytest.CaptureFixture[str]) -> None:
    token = guarded.store.tokens.create("me", "control")
    ticket = guarded.client.post("/tickets", headers=bearer(token)).json()["ticket"]
    address = f"127.0.0.1:{guarded.client.base_url.port}/api/v1"
    with connect(f"ws://{address}/events?ticket={ticket}"):
        assert guarded.client.get("/scenes", headers=bearer(token)).status_code == 200
        assert guarded.client.get(f"/scenes?ticket={ticket}").status_code == 401
        assert guarded.client.get("/scenes", headers=bearer(f"{token}x")).status_code == 401
    for text in capfd.readouterr():
        assert token not in text
        assert ticket not in text


def test_role_view_may_look_only(guarded: RunningApi) -> None:
    client, headers = guarded.client, bearer(guarded.store.tokens.create("wall", "view"))
    scene_id = guarded.store.scenes.create({"name": "room"}).head.id
    assert client.get(f"/scenes/{scene_id}", headers=headers).status_code == 200
    for method, path in (
        ("PATCH", f"/scenes/{scene_id}"),
        ("DELETE", f"/scenes/{scene_id}"),
        ("POST", "/assets?name=a.glb"),
        ("POST", f"/scenes/{scene_id}/activate"),
    ):
        assert "is read-only" in sentence(client.request(method, path, headers=headers), 403)
    assert guarded.store.scenes.get(scene_id).document.revision == 1


def test_guessing_tokens_is_slowed_down_and_counted(guarded: RunningApi) -> None:
    client = guarded.client
    for number in range(WRONG_TOKENS_AT_ONCE):
        assert client.get("/scenes", headers=bearer(f"guess{number}")).status_code == 401
    answer = client.get("/scenes", headers=bearer(guarded.store.tokens.create("me", "view")))
    assert "Too many wrong tokens" in sentence(answer, 429)
    assert int(answer.headers["retry-after"]) >= 1
    assert client.get("/health").status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "http://[", ""])
def test_pages_of_other_sites_are_refused(open_api: RunningApi, origin: str) -> None:
    client = open_api.client
    assert "other sites" in sentence(client.post("/scenes", json={}, headers={"Origin": origin}), 403)
    assert client.get("/scenes").json() == []
    own = f"http://{client.base_url.host}:{client.base_url.port}"
    assert client.post("/scenes", json={}, headers={"Origin": own}).status_code == 201


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "", "["])
def test_names_that_only_resolve_to_loopback_are_refused(open_api: RunningApi, host: str) -> None:
    assert "on loopback" in sentence(open_api.client.get("/scenes", headers={"Host": host}), 400)


def test_elsewhere_names_that_only_resolve_to_this_host_are_refused(tmp_path: Path) -> None:
    with running_api(tmp_path, host="0.0.0.0", allowed_hosts=["Station.Example."]) as running:
        client, address = running.client, f"127.0.0.1:{running.client.base_url.port}"
        own = (socket.gethostname(), f"{socket.gethostname().partition('.')[0]}.local", "localhost")
        literal = ("127.0.0.1", "[::1]:8000", "192.168.1.20:80")
        for host in (*own, *literal, "station.example", "STATION.example.:8000"):
            assert client.get("/health", headers={"Host": host}).status_code == 200, host
        for host in (
            "evil.example",
            "station.example.evil.example",
            "127.0.0.1.evil.example",
            "2130706433",
            "",
            "[",
        ):
            told = sentence(client.get("/health", headers={"Host": host}), 400)
            assert "`allowed_hosts` in [api] of deltalight.toml" in told, host
            page = client.get(f"http://{address}/", headers={"Host": host})
            assert page.status_code == 400, host
        token = running.store.tokens.create("me", "control")
        for host, status in (("evil.example", 400), ("station.example", None)):
            with socket.create_connection(("127.0.0.1", running.client.base_url.port)) as raw:
                made = connect_as(raw, host, token)
            assert made == status


def connect_as(raw: socket.socket, host: str, token: str) -> int | None:
    """Opens a WebSocket under a name; the status with which that is refused, None if it is not."""
    try:
        with connect(f"ws://{host}/api/v1/events", sock=raw, additional_headers=bearer(token)):
            return None
    except InvalidStatus as refusal:
        return refusal.response.status_code


@pytest.mark.parametrize(
    "name", ["https://station.example", "station.example:8000", "*", "*.example", "", "a b"]
)
def test_an_allowed_host_is_a_name(name: str) -> None:
    with pytest.raises(DeltalightError, match="without scheme, port and wildcard"):
        validate(ApiSettings, {"allowed_hosts": [name]}, "[api]")


def test_no_answer_carries_cross_origin_rights_or_cookies(open_api: RunningApi) -> None:
    answer = open_api.client.options("/scenes", headers={"Access-Control-Request-Method": "DELETE"})
    assert answer.status_code == 405
    for response in (answer, open_api.client.get("/scenes")):
        assert not {"access-control-allow-origin", "set-cookie", "server"} & set(response.headers)


def ended(connection: socket.socket) -> bool:
    """Waits until the service closes a connection."""
    connection.settimeout(30)
    return connection.recv(1) == b""


def rest_of(connection: socket.socket) -> bytes:
    """What comes until the service closes a connection."""
    connection.settimeout(30)
    return b"".join(iter(lambda: connection.recv(1 << 20), b""))


def test_connections_that_ask_nothing_take_nobodys_place(
    guarded: RunningApi, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = str(guarded.client.base_url.host), guarded.client.base_url.port
    assert guarded.client.get("/health").status_code == 200
    monkeypatch.setattr(connections, "CONNECTIONS_PER_CLIENT", 8)
    idle = [socket.create_connection(address) for _ in range(12)]
    assert ended(idle[-1])
    assert guarded.client.get("/health").status_code == 200
    for each in idle:
        each.close()
    monkeypatch.setattr(connections, "HEAD_TIMEOUT_S", 0.2)
    with socket.create_connection(address) as silent, socket.create_connection(address) as dripping:
        dripping.sendall(b"GET /api/v1/health HTT")
        assert ended(silent)
        assert ended(dripping)


@pytest.mark.parametrize("drip", [b"", b" "])
def test_a_body_that_stays_away_or_comes_in_drips_takes_nobodys_place(
    open_api: RunningApi, monkeypatch: pytest.MonkeyPatch, drip: bytes
) -> None:
    monkeypatch.setattr(connections, "BODY_WINDOW_S", 0.2)
    with socket.create_connection((open_api.client.base_url.host, open_api.client.base_url.port)) as slow:
        slow.sendall(b"POST /api/v1/scenes HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9999\r\n\r\n{")
        slow.sendall(drip)
        assert ended(slow)
    answer = open_api.client.post(
        "/scenes", content=b" " * 100_000 + b"{}", headers={"Content-Type": "application/json"}
    )
    assert answer.status_code == 201


def test_who_takes_no_answer_takes_nobodys_place(
    open_api: RunningApi, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "STALL_TIMEOUT_S", 0.2)
    large = upload(open_api.store, TETRAHEDRON + b"#" * 20_000_000, "large.obj", limit_bytes=1 << 25)
    path = f"/api/v1/assets/{large.reference}/content"
    with socket.create_connection((open_api.client.base_url.host, open_api.client.base_url.port)) as deaf:
        deaf.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        assert deaf.recv(12) == b"HTTP/1.1 200"
        time.sleep(1.0)
        assert len(rest_of(deaf)) < 20_000_000
    assert len(open_api.client.get(path.removeprefix("/api/v1")).content) > 20_000_000


def http_connections() -> int:
    """Those that this process, which serves, still holds."""
    gc.collect()
    return sum(isinstance(each, connections.LimitedProtocol) for each in gc.get_objects())


def test_a_websocket_does_not_keep_the_connection_that_it_began_as(open_api: RunningApi) -> None:
    before, url = http_connections(), open_api.client.base_url
    with ExitStack() as stack:
        for _ in range(10):
            stack.enter_context(connect(f"ws://{url.host}:{url.port}/api/v1/live"))
        assert http_connections() < before + 5


def test_refused_sockets_and_broken_requests_write_hardly_a_line(
    guarded: RunningApi, caplog: pytest.LogCaptureFixture
) -> None:
    address = guarded.client.base_url.host, guarded.client.base_url.port
    for _ in range(20):
        with pytest.raises(InvalidStatus):
            connect(f"ws://{address[0]}:{address[1]}/api/v1/live")
        with socket.create_connection(address) as broken:
            broken.sendall(b"\0\r\n\r\n")
            assert b" 400 " in rest_of(broken)
    assert len([record for record in caplog.records if record.name.startswith("uvicorn")]) <= 1


def test_too_many_requests_are_told_when_to_come_again(tmp_path_factory: pytest.TempPathFactory) -> None:
    with running_api(tmp_path_factory.mktemp("data"), requests_per_s=1) as running:
        answers = [running.client.get("/health") for _ in range(12)]
    assert answers[0].status_code == 200
    late = next(answer for answer in answers if answer.status_code == 429)
    assert "Too many requests" in sentence(late, 429)
    assert int(late.headers["retry-after"]) >= 1


def test_requests_with_one_token_are_limited_whatever_addresses_they_come_from(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    with running_api(tmp_path_factory.mktemp("data"), requests_per_s=1) as running:
        tokens = [running.store.tokens.create(name, "view") for name in ("shared", "other")]

        def statuses(token: str, addresses: Iterable[int]) -> list[int]:
            found = []
            for last in addresses:
                transport = httpx.HTTPTransport(local_address=f"127.0.0.{last}")
                with httpx.Client(base_url=running.client.base_url, transport=transport) as client:
                    found.append(client.get("/scenes", headers=bearer(token)).status_code)
            return found

        shared = statuses(tokens[0], range(2, 42))
        assert shared[: 2 * ADDRESSES_OF_TOKEN] == [200] * (2 * ADDRESSES_OF_TOKEN)
        assert 429 in shared
        assert statuses(tokens[1], range(2, 4)) == [200, 200]


def test_a_bucket_refills_and_forgets_old_clients() -> None:
    now_s = 0.0
    limit = RateLimit(2, 3, lambda: now_s)
    for _ in range(3):
        assert limit.wait_s("a") == 0
        limit.take("a")
    assert limit.wait_s("a") == 0.5
    assert limit.wait_s("b") == 0
    now_s = 0.5
    assert limit.wait_s("a") == 0
    now_s = 100.0
    for client in range(REMEMBERED_CLIENTS + 5):
        limit.take(str(client))
    assert len(limit._buckets) == REMEMBERED_CLIENTS


def test_large_documents_are_refused_before_they_are_read(open_api: RunningApi) -> None:
    answer = open_api.client.post("/scenes", json={"name": "x" * (3 << 20)})
    assert "larger than 2 MB" in sentence(answer, 413)


def test_the_description_is_open_and_names_no_secret(guarded: RunningApi) -> None:
    root = f"http://{guarded.client.base_url.host}:{guarded.client.base_url.port}"
    schema = httpx.get(f"{root}/openapi.json", timeout=60).json()
    assert "/api/v1/scenes/{scene_id}" in schema["paths"]


def test_a_token_file_lets_in_with_role_control(tmp_path: Path) -> None:
    secret, other = "s" * 40, "t" * 40
    (tmp_path / "token").write_text(f"{secret}\n")
    with running_api(tmp_path / "data", host="0.0.0.0", token_file=str(tmp_path / "token")) as running:
        assert running.client.post("/scenes", json={}, headers=bearer(secret)).status_code == 201
        assert "is unknown" in sentence(running.client.get("/scenes", headers=bearer(other)), 401)
        assert running.store.tokens.all() == []


@pytest.mark.parametrize("content", [b"", b"short", b"two words " * 4, b"\xff" * 40])
def test_a_token_file_that_holds_no_secret_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "token").write_bytes(content)
    with pytest.raises(DeltalightError, match="the token file"):
        SecretToken(tmp_path / "token")
    with pytest.raises(DeltalightError, match="cannot be read"):
        SecretToken(tmp_path / "absent")
