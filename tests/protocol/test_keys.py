"""Key files: made closed, listed, trusted; what is wrong is a sentence that names the command to run."""

import stat
from pathlib import Path

import pytest

from deltalight.protocol.endpoints import parse_endpoint
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import (
    KeySettings,
    create_keys,
    key_folder,
    load_keys,
    own_keys,
    trust,
    trusted_keys,
)
from deltalight.protocol.rights import allow, allowed


def test_a_secret_key_is_its_owners_only(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "keys"
    public, secret = create_keys("desk", folder)
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    keys = load_keys(None, folder)
    assert keys.name == "desk"
    assert keys.secret not in public.read_bytes()
    assert keys.secret.decode() not in repr(keys)
    assert sorted(path.name for path in folder.iterdir()) == ["desk.key", "desk.key_secret"]


def test_a_secret_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    _, secret = create_keys("desk", tmp_path)
    secret.chmod(0o640)
    with pytest.raises(DeltalightError, match="chmod 600"):
        load_keys("desk", tmp_path)


def test_keys_are_never_written_over(tmp_path: Path) -> None:
    _, secret = create_keys("desk", tmp_path)
    before = secret.read_bytes()
    with pytest.raises(DeltalightError, match="has keys called `desk`"):
        create_keys("desk", tmp_path)
    assert secret.read_bytes() == before
    with pytest.raises(DeltalightError, match="is not a valid name"):
        create_keys("../desk", tmp_path)


def test_trusting_keeps_a_public_key_and_refuses_a_secret_one(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    public, secret = create_keys("desk", there)
    with pytest.raises(DeltalightError, match="stays on its host"):
        trust(secret, here)
    assert trusted_keys(here) == {}
    assert trust(public, here) == here / "trusted" / "desk.key"
    assert trusted_keys(here) == {"desk": load_keys("desk", there).public}
    trust(public, here)  # again is no error
    other, _ = create_keys("desk", tmp_path / "elsewhere")
    with pytest.raises(DeltalightError, match="another key is trusted as `desk`"):
        trust(other, here)
    trust(other, here, "desk2")
    assert list(trusted_keys(here)) == ["desk", "desk2"]
    (here / "trusted" / "torn.key").write_text("no key")
    assert list(trusted_keys(here)) == ["desk", "desk2"]
    with pytest.raises(DeltalightError, match="is not a key file"):
        trust(here / "trusted" / "torn.key", there)


def test_settings_load_keys_only_where_an_endpoint_needs_them(tmp_path: Path) -> None:
    settings = KeySettings(folder=tmp_path)
    assert settings.load(["tcp://127.0.0.1:5601", "ipc:///run/x"]) is None
    with pytest.raises(DeltalightError, match=r"tcp://0\.0\.0\.0:5601 needs keys.*deltalight keys create"):
        settings.load(["tcp://127.0.0.1:5602", "tcp://0.0.0.0:5601"])
    create_keys("desk", tmp_path)
    for endpoint in ("tcp://0.0.0.0:5601", "tcp://gpu@127.0.0.1:5601", "tcp://[fe80::1]:5601"):
        keys = settings.load([endpoint])
        assert keys is not None
        assert keys.name == "desk"
    everywhere = settings.replaced(on_loopback=True)
    assert everywhere.load(["tcp://127.0.0.1:5601"]) is not None
    assert everywhere.load(["ipc:///run/x"]) is None
    create_keys("lamp", tmp_path)
    with pytest.raises(DeltalightError, match="desk, lamp"):
        settings.load(["tcp://0.0.0.0:5601"])
    with pytest.raises(DeltalightError, match="none called `cellar`"):
        settings.replaced(name="cellar").load(["tcp://0.0.0.0:5601"])


def test_the_key_behind_an_endpoint_is_the_named_or_the_only_one(tmp_path: Path) -> None:
    create_keys("gpu", tmp_path)
    keys = load_keys(None, tmp_path)
    plain, named = parse_endpoint("tcp://10.0.0.5:5601"), parse_endpoint("tcp://shelf@10.0.0.5:5601")
    with pytest.raises(DeltalightError, match="deltalight keys trust"):
        keys.peer(plain)
    trust(create_keys("desk", tmp_path / "a")[0], tmp_path)
    assert keys.peer(plain) == load_keys("desk", tmp_path / "a").public
    trust(create_keys("shelf", tmp_path / "b")[0], tmp_path)
    assert keys.peer(named) == load_keys("shelf", tmp_path / "b").public
    with pytest.raises(DeltalightError, match=r"tcp://NAME@HOST:PORT with one of desk, shelf"):
        keys.peer(plain)
    with pytest.raises(DeltalightError, match="nearest trusted name is shelf"):
        keys.peer(parse_endpoint("tcp://shelv@10.0.0.5:5601"))
    assert own_keys(tmp_path) == ["gpu"]


def test_processes_of_one_host_know_each_other_by_its_own_key(tmp_path: Path) -> None:
    create_keys("gpu", tmp_path)
    keys = load_keys(None, tmp_path)
    assert keys.peer(parse_endpoint("tcp://127.0.0.1:5601")) == keys.public
    assert keys.peer(parse_endpoint("tcp://gpu@127.0.0.1:5601")) == keys.public
    assert keys.trusted() == {"gpu": keys.public}


def test_an_endpoint_may_name_its_hosts_key() -> None:
    parts = parse_endpoint("tcp://desk@10.0.0.5:5601")
    assert (parts.address, parts.peer, parts.host, parts.port) == (
        "tcp://10.0.0.5:5601",
        "desk",
        "10.0.0.5",
        5601,
    )
    assert parts.needs_keys
    assert parse_endpoint("tcp://desk@127.0.0.1:1").needs_keys
    assert not parse_endpoint("tcp://127.0.0.1:1").needs_keys
    assert parse_endpoint("tcp://*:5601").leaves_host
    with pytest.raises(DeltalightError, match="not an endpoint"):
        parse_endpoint("tcp://de sk@10.0.0.5:5601")


def test_the_users_folder_follows_xdg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert key_folder() == tmp_path / "deltalight" / "keys"


def test_what_a_key_allows_is_known_streams_topics_and_control(tmp_path: Path) -> None:
    (tmp_path / "trusted").mkdir()
    assert allowed(tmp_path, "desk") is None
    allow(tmp_path, "desk", ["color", "pose.desk", "control"])
    assert allowed(tmp_path, "desk") == frozenset({"color", "pose.desk", "control"})
    for word in ("colour", "color.", "color.a.b", "request", "../x", "*"):
        with pytest.raises(DeltalightError, match="not a stream, topic or `control`"):
            allow(tmp_path, "desk", [word])
    (tmp_path / "trusted" / "desk.allow").write_bytes(b"\xff\xff")
    assert allowed(tmp_path, "desk") == frozenset(), "a list that cannot be read allows nothing"
    allow(tmp_path, "desk", None)
    assert allowed(tmp_path, "desk") is None
