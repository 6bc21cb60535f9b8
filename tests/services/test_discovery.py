"""Nodes on the network, on loopback: announced, found, chosen, trusted."""

from pathlib import Path

import pytest
from zeroconf import ServiceInfo

from deltalight.protocol.endpoints import parse_endpoint
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys, KeySettings, create_keys, load_keys, trust
from deltalight.protocol.messages import SCHEMA_VERSION
from deltalight.sensor_node.announce import SERVICE_TYPE, announced, service_info
from deltalight.services import discovery
from deltalight.services.discovery import FoundNode, choose, find_nodes, node_endpoint

LOOPBACK = ["127.0.0.1"]
STREAMS = ("color", "pose")


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    create_keys("desk-host", tmp_path / "node")
    return load_keys(None, tmp_path / "node")


@pytest.mark.slow
def test_a_node_is_found_with_all_it_says_and_is_trusted_by_its_key(keys: Keys, tmp_path: Path) -> None:
    with announced("desk", "tcp://127.0.0.1:5999", STREAMS, keys, interfaces=LOOPBACK):
        found = find_nodes(name="desk", listen_s=10, interfaces=LOOPBACK)
        node = FoundNode("desk", "127.0.0.1", 5999, STREAMS, SCHEMA_VERSION, keys.public.decode())
        assert node in found
        settings = KeySettings(folder=tmp_path / "server")
        with pytest.raises(DeltalightError, match="deltalight keys trust"):
            node_endpoint("desk", settings, interfaces=LOOPBACK)
        trust(keys.folder / "desk-host.key", tmp_path / "server")
        assert node_endpoint("desk", settings, interfaces=LOOPBACK) == "tcp://desk-host@127.0.0.1:5999"
    assert "desk" not in [each.name for each in find_nodes(listen_s=1, interfaces=LOOPBACK)]


def test_a_node_that_stays_on_its_host_is_not_announced() -> None:
    with (
        announced("hidden", "tcp://127.0.0.1:5998", STREAMS, None),
        announced("x", "ipc:///run/x", STREAMS, None),
    ):
        assert find_nodes(name="hidden", listen_s=1, interfaces=LOOPBACK) == []


def test_the_announcement_never_holds_a_secret(keys: Keys) -> None:
    info = service_info("desk", parse_endpoint("tcp://127.0.0.1:5999"), STREAMS, keys, LOOPBACK)
    assert keys.public in info.text
    assert keys.secret not in info.text


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({b"name": b"desk\x1b[2J"}, None),
        ({b"name": b"\xff"}, None),
        ({b"name": b"desk\n"}, None),
        ({b"schema": b"-5"}, None),
        ({b"streams": b"color,\x1b]0;x\x07"}, FoundNode("desk", "10.0.0.5", 5601, ("color",), 5, "k")),
        ({b"key": b"\x1b[31m"}, FoundNode("desk", "10.0.0.5", 5601, STREAMS, 5, "")),
    ],
)
def test_what_strangers_announce_writes_nothing_odd_to_a_terminal(
    said: dict[bytes, bytes], expected: FoundNode | None
) -> None:
    texts = {
        b"name": b"desk",
        b"schema": b"5",
        b"streams": b"color,pose",
        b"curve": b"1",
        b"key": b"k",
        **said,
    }
    address = bytes([10, 0, 0, 5])
    info = ServiceInfo(SERVICE_TYPE, f"x.{SERVICE_TYPE}", port=5601, addresses=[address], properties=texts)
    assert discovery._node(info) == expected


def test_one_node_is_chosen_by_name_or_because_it_is_the_only_one() -> None:
    desk, shelf = (FoundNode(name, "10.0.0.5", 5601, STREAMS, SCHEMA_VERSION) for name in ("desk", "shelf"))
    assert choose([desk], "auto") is desk
    assert choose([desk, shelf], "shelf") is shelf
    for nodes, name, sentence in (
        ([], "auto", "no node announces itself"),
        ([desk, shelf], "auto", "say which with --node: desk, shelf"),
        ([desk, shelf], "shelve", "the nearest is shelf of desk, shelf"),
    ):
        with pytest.raises(DeltalightError, match=sentence):
            choose(nodes, name)


def test_another_version_and_missing_keys_are_sentences() -> None:
    with pytest.raises(DeltalightError, match="speaks version 1"):
        FoundNode("desk", "10.0.0.5", 5601, STREAMS, 1).endpoint({})
    with pytest.raises(DeltalightError, match="has no keys"):
        FoundNode("desk", "10.0.0.5", 5601, STREAMS, SCHEMA_VERSION).endpoint({})
    node = FoundNode("desk", "fe80::1", 5601, STREAMS, SCHEMA_VERSION, "k")
    assert node.endpoint({"desk": b"k"}) == "tcp://desk@[fe80::1]:5601"
