"""Encrypted sockets on loopback, with keys forced on: who gets in, who gets nothing, what is counted."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import structlog

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys, create_keys, load_keys, trust
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import ReplyServer, RequestClient
from deltalight.protocol.rights import allow

ANY = "tcp://127.0.0.1:0"
SETTLE_S = 30.0
# What a refused receiver is given to get something by mistake: many reconnects and handshakes.
PATIENCE_S = 0.8
# Several attempts of libzmq to connect.
REFUSED_S = 0.5


@dataclass(frozen=True)
class Hosts:
    """A node, a server that it trusts, and a stranger that trusts the node."""

    node: Keys
    server: Keys
    stranger: Keys


def keys_of(folder: Path, name: str) -> Keys:
    create_keys(name, folder)
    return replace(load_keys(name, folder), on_loopback=True)


@pytest.fixture
def hosts(tmp_path: Path) -> Hosts:
    made = Hosts(*(keys_of(tmp_path / name, name) for name in ("node", "server", "stranger")))
    trust(made.server.folder / "server.key", made.node.folder)
    trust(made.node.folder / "node.key", made.server.folder)
    trust(made.node.folder / "node.key", made.stranger.folder)
    return made


def at_node(endpoint: str) -> str:
    """The endpoint as one whose host has the node's key."""
    return endpoint.replace("tcp://", "tcp://node@")


def gets_something(publisher: Publisher, receiver: Receiver, patience_s: float = SETTLE_S) -> bool:
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        publisher.send([b"hello", b""])
        if receiver.latest(0.05):
            return True
    return False


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SETTLE_S
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert condition()


def test_a_trusted_key_gets_the_stream(hosts: Hosts, opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY, keys=hosts.node))
    receiver = opened(Receiver([at_node(publisher.endpoint)], ["hello"], keys=hosts.server))
    assert gets_something(publisher, receiver)
    assert publisher.refused == 0


def test_processes_of_one_host_share_its_keys(hosts: Hosts, opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY, keys=hosts.node))
    receiver = opened(Receiver([publisher.endpoint], ["hello"], keys=hosts.node))
    assert gets_something(publisher, receiver)


def test_an_unknown_key_gets_nothing_is_counted_and_told_at_both_ends(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    with structlog.testing.capture_logs() as lines:
        publisher = opened(Publisher(ANY, keys=hosts.node))
        stranger = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.stranger))
        assert not gets_something(publisher, stranger, PATIENCE_S)
        assert publisher.refused > 0
        reasons = [line["reason"] for line in lines if line["event"] == "connection refused"]
    assert sum("its key is not trusted" in reason for reason in reasons) == 1
    assert sum("our key is not trusted there" in reason for reason in reasons) == 1
    receiver = opened(Receiver([at_node(publisher.endpoint)], ["hello"], keys=hosts.server))
    assert gets_something(publisher, receiver)


def test_no_keys_get_nothing_and_are_counted(hosts: Hosts, opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY, keys=hosts.node))
    plain = opened(Receiver([publisher.endpoint], []))
    assert not gets_something(publisher, plain, PATIENCE_S)
    assert publisher.refused > 0


def test_a_receiver_with_keys_takes_nothing_from_a_publisher_without(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    publisher = opened(Publisher(ANY))
    receiver = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.server))
    assert not gets_something(publisher, receiver, PATIENCE_S)


def test_a_node_with_another_key_is_not_taken_for_the_trusted_one(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    trust(hosts.server.folder / "server.key", hosts.stranger.folder)
    impostor = opened(Publisher(ANY, keys=hosts.stranger))
    receiver = opened(Receiver([at_node(impostor.endpoint)], [], keys=hosts.server))
    assert not gets_something(impostor, receiver, PATIENCE_S)


def test_trust_holds_from_the_next_connection_on_without_a_restart(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    publisher = opened(Publisher(ANY, keys=hosts.node))
    before = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.stranger))
    assert not gets_something(publisher, before, PATIENCE_S)
    kept = trust(hosts.stranger.folder / "stranger.key", hosts.node.folder)
    now = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.stranger))
    assert gets_something(publisher, now)
    kept.unlink()
    later = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.stranger))
    assert not gets_something(publisher, later, PATIENCE_S)


def test_one_receiver_hears_a_node_of_this_host_and_one_with_keys(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    """Each order: the keys of one endpoint must not stick to the next."""
    plain, coded = opened(Publisher(ANY)), opened(Publisher(ANY, keys=hosts.node))
    named = at_node(coded.endpoint)
    for endpoints in ([plain.endpoint, named], [named, plain.endpoint]):
        receiver = opened(Receiver(endpoints, [], keys=replace(hosts.server, on_loopback=False)))
        assert gets_something(plain, receiver)
        assert gets_something(coded, receiver)


def test_a_node_that_connects_to_a_bound_receiver_needs_a_trusted_key(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    receiver = opened(Receiver([ANY], [], bind=True, keys=hosts.node))
    stranger = opened(Publisher(at_node(receiver.endpoints[0]), bind=False, keys=hosts.stranger))
    assert not gets_something(stranger, receiver, PATIENCE_S)
    trusted = opened(Publisher(at_node(receiver.endpoints[0]), bind=False, keys=hosts.server))
    assert gets_something(trusted, receiver)


def test_control_needs_a_trusted_key(hosts: Hosts, opened: Callable[[Any], Any]) -> None:
    server = opened(ReplyServer(ANY, lambda request: {"op": request.op}, keys=hosts.node))
    question = ControlRequest(node="a", id="1", op="status")
    trusted = opened(RequestClient(at_node(server.endpoint), keys=hosts.server))
    assert trusted.request(question, SETTLE_S).payload == {"op": "status"}
    for endpoint, keys in ((server.endpoint, None), (at_node(server.endpoint), hosts.stranger)):
        client = opened(RequestClient(endpoint, keys=keys))
        with pytest.raises(DeltalightError, match="no answer"):
            client.request(question, PATIENCE_S)
    wait_until(lambda: server.refused > 0)
    assert trusted.request(question.model_copy(update={"id": "2"}), SETTLE_S).ok


def test_a_host_may_publish_only_what_its_key_allows(hosts: Hosts, opened: Callable[[Any], Any]) -> None:
    allow(hosts.server.folder, "node", ["color", "pose.desk"])
    publisher = opened(Publisher(ANY, keys=hosts.node))
    with structlog.testing.capture_logs() as lines:
        receiver = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.server))
        found: set[str] = set()

        def sent() -> bool:
            for topic in (
                b"lights.desk",
                b"pose.shelf",
                b"color.shelf",
                b"pose.desk",
                b"colors.desk",
                b"lights.desk",
            ):
                publisher.send([topic, b""])
            found.update(receiver.latest(0.05) or {})
            return len(found) == 2 and receiver.not_allowed > 0

        wait_until(sent)
        assert found == {"color.shelf", "pose.desk"}
        assert receiver.drops["not_allowed"] == receiver.not_allowed
    sentences = [line["reason"] for line in lines if "may not" in line["event"]]
    assert len(sentences) == len({sentence.split(";")[0] for sentence in sentences}) == 3
    assert (
        "the key `node` does not allow lights.desk; if it should, add lights to `deltalight keys allow"
        in str(sentences)
    )
    allow(hosts.server.folder, "node", None)
    before = opened(Receiver([at_node(publisher.endpoint)], [], keys=hosts.server))
    wait_until(lambda: publisher.send([b"lights.desk", b""]) or bool(before.latest(0.05)))


def test_rights_hold_for_hosts_that_connect_and_for_commands(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    allow(hosts.node.folder, "server", ["pose"])
    receiver = opened(Receiver([ANY], [], bind=True, keys=hosts.node))
    publisher = opened(Publisher(at_node(receiver.endpoints[0]), bind=False, keys=hosts.server))
    found: set[str] = set()

    def sent() -> bool:
        publisher.send([b"color.desk", b""])
        publisher.send([b"pose.desk", b""])
        found.update(receiver.latest(0.05) or {})
        return bool(found) and receiver.not_allowed > 0

    wait_until(sent)
    assert found == {"pose.desk"}
    server = opened(ReplyServer(ANY, lambda request: {"op": request.op}, keys=hosts.node))
    client = opened(RequestClient(at_node(server.endpoint), keys=hosts.server))
    answers = [
        client.request(ControlRequest(node="a", id=str(number), op=op), SETTLE_S)
        for number, op in enumerate(["clock", "set_scene", "ping"])
    ]
    assert [answer.ok for answer in answers] == [True, False, True]
    assert "the key `server` does not allow control" in str(answers[1].error)
    assert server.not_allowed == 1
    allow(hosts.node.folder, "server", ["pose", "control"])
    numbers = count(3)  # rights are read once a second
    wait_until(
        lambda: client.request(ControlRequest(node="a", id=str(next(numbers)), op="set_scene"), SETTLE_S).ok
    )


# How a peer that wants keys begins (ZMTP 3.1, section 3.1): signature, version, mechanism, as server, filler.
CURVE_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"CURVE".ljust(20, b"\0") + b"\x01" + bytes(31)


def greet(listener: socket.socket) -> None:
    kept = []  # a closed connection would be a fault of the line, not a refusal
    with suppress(OSError):
        while True:
            connection, _ = listener.accept()
            kept.append(connection)
            connection.sendall(CURVE_GREETING)
    for connection in kept:
        connection.close()


def test_a_request_ends_in_time_where_the_refusal_left_nobody_to_send_to(
    opened: Callable[[Any], Any],
) -> None:
    """libzmq takes the pipe of a refused connection away in about every third case, so there are many clients."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=greet, args=(listener,), daemon=True).start()
        clients = [opened(RequestClient(f"tcp://127.0.0.1:{listener.getsockname()[1]}")) for _ in range(12)]
        time.sleep(REFUSED_S)
        for client in clients:
            with pytest.raises(DeltalightError, match="no answer"):
                client.request(ControlRequest(node="a", id="1", op="status"), 0.1)
        listener.shutdown(socket.SHUT_RDWR)


def test_a_host_whose_key_is_unknown_is_refused_before_connecting(hosts: Hosts) -> None:
    for build in (
        lambda: Receiver(["tcp://shelf@10.0.0.5:5601"], [], keys=hosts.server),
        lambda: RequestClient("tcp://shelf@10.0.0.5:5601", keys=hosts.server),
    ):
        with pytest.raises(DeltalightError, match="no key of `shelf` is trusted"):
            build()


def test_on_loopback_keys_are_used_only_where_that_is_asked_for(
    hosts: Hosts, opened: Callable[[Any], Any]
) -> None:
    publisher = opened(Publisher(ANY, keys=replace(hosts.node, on_loopback=False)))
    plain = opened(Receiver([publisher.endpoint], ["hello"]))
    assert gets_something(publisher, plain)
    assert publisher.refused == 0
