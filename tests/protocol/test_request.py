"""Control over real sockets on loopback: idempotent, in time, and never silent about a fault."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
import zmq

from deltalight.protocol.envelope import EnvelopeError, decode, encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import (
    MAX_HEADER_BYTES,
    OLDEST_SCHEMA_VERSION,
    SCHEMA_VERSION,
    ControlReply,
    ControlRequest,
    StatsMessage,
)
from deltalight.protocol.payloads import INLINE_CHARACTERS, decode_control, encode_control
from deltalight.protocol.request import ReplyMemory, ReplyServer, RequestClient
from deltalight.protocol.sockets import open_context

ANY = "tcp://127.0.0.1:0"


def request(**fields: object) -> ControlRequest:
    return ControlRequest.model_validate({"node": "api", "id": "r1", "op": "set_scene", **fields})


def noting(done: list[ControlRequest]) -> Callable[[ControlRequest], dict[str, object]]:
    """Keeps what it carries out, and answers how much that is."""

    def handler(control: ControlRequest) -> dict[str, object]:
        done.append(control)
        return {"n": len(done)}

    return handler


def test_request_and_reply(opened: Callable[[Any], Any]) -> None:
    server = opened(ReplyServer(ANY, lambda control: {"echo": control.payload, "op": control.op}, node="gpu"))
    client = opened(RequestClient(server.endpoint))
    reply = client.request(request(payload={"a": [1, 2.5, None]}), 30)
    assert (reply.id, reply.ok, reply.error, reply.node) == ("r1", True, None, "gpu")
    assert reply.payload == {"echo": {"a": [1, 2.5, None]}, "op": "set_scene"}


@pytest.mark.parametrize("length", [INLINE_CHARACTERS - 100, INLINE_CHARACTERS, MAX_HEADER_BYTES, 4_000_000])
def test_payloads_up_to_4_mb_pass_both_ways(opened: Callable[[Any], Any], length: int) -> None:
    server = opened(ReplyServer(ANY, lambda control: control.payload))
    client = opened(RequestClient(server.endpoint))
    payload: dict[str, object] = {"scene": {"name": "\u00e4" + "x" * length, "numbers": [1.0] * 100}}
    reply = client.request(request(payload=payload), 20)
    assert (reply.ok, reply.error, reply.payload_bytes) == (True, None, None)
    assert reply.payload == payload


def test_a_header_of_numbers_that_is_not_a_part_yet_still_fits() -> None:
    numbers = [1.0] * ((INLINE_CHARACTERS - 20) // len("1.0, "))
    assert len(encode_control(request(payload={"n": numbers}))) == 2
    assert len(encode_control(request(payload={"n": [*numbers, *numbers]}))) == 3


def test_a_payload_beyond_4_mb_is_refused_before_it_is_sent(opened: Callable[[Any], Any]) -> None:
    client = opened(RequestClient("tcp://127.0.0.1:9"))
    with pytest.raises(EnvelopeError, match="4194304 are allowed"):
        client.request(request(payload={"text": "x" * 4_200_000}), 0.1)


def test_a_long_payload_is_not_carried_out_twice(opened: Callable[[Any], Any]) -> None:
    done: list[ControlRequest] = []
    server = opened(ReplyServer(ANY, noting(done)))
    client = opened(RequestClient(server.endpoint))
    payload: dict[str, object] = {"text": "x" * 100_000}
    for name in ("r1", "r1", "r2"):
        assert client.request(request(id=name, revision=3, payload=payload), 30).ok
    assert not client.request(request(id="r3", revision=3, payload={"text": "y" * 100_000}), 30).ok
    assert [control.id for control in done] == ["r1"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"{", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"[1]", "not plain data"),
        (b'{"n": NaN}', "not plain data"),
        (b'{"n": 1e999}', "not plain data"),
        (b'{"text": ["\\ud800"]}', "lone surrogate"),
        (b'{"a": {"\\udfff": 1}}', "lone surrogate"),
        (b'{"a": ' * 30 + b"1" + b"}" * 30, "not plain data"),
        (b'{"a": ' * 100_000 + b"1" + b"}" * 100_000, "not JSON"),
        (b'{"n": ' + b"9" * 5000 + b"}", "not JSON"),
    ],
)
def test_a_payload_that_is_no_plain_data_is_one_sentence(text: bytes, reason: str) -> None:
    pieces = encode(request(payload_bytes=len(text)), [text])
    with pytest.raises(EnvelopeError, match=reason):
        decode_control(pieces, ControlRequest)


def test_a_payload_is_given_once() -> None:
    with pytest.raises(ValueError, match="must be empty"):
        request(payload={"a": 1}, payload_bytes=2)


def test_a_server_that_is_closed_by_a_request_still_answers_it(opened: Callable[[Any], Any]) -> None:
    asked = threading.Event()

    def handler(control: ControlRequest) -> dict[str, object]:
        asked.set()
        time.sleep(0.1)  # the owner closes the server meanwhile
        return {"op": control.op}

    server = ReplyServer(ANY, handler)
    client = opened(RequestClient(server.endpoint))

    def close_when_asked() -> None:
        asked.wait(30)
        server.close()

    owner = threading.Thread(target=close_when_asked)
    owner.start()
    assert client.request(request(op="shutdown"), 30).payload == {"op": "shutdown"}
    owner.join()


def test_refusals_faults_and_bad_answers_are_sentences_and_the_server_lives_on(
    opened: Callable[[Any], Any],
) -> None:
    def handler(control: ControlRequest) -> dict[str, object]:
        if control.op == "refuse":
            raise DeltalightError("the scene has no object: add one")
        if control.op == "surrogate":
            raise DeltalightError("there is no \ud800" + "x" * 3000)
        if control.op == "fault":
            raise ZeroDivisionError("oops")
        return {"large": "x" * 5_000_000} if control.op == "large" else {"object": object()}

    server = opened(ReplyServer(ANY, handler))
    client = opened(RequestClient(server.endpoint))
    answers = {
        op: client.request(request(id=op, op=op), 30)
        for op in ("refuse", "surrogate", "fault", "large", "odd", "refuse")
    }
    assert not any(answer.ok for answer in answers.values())
    assert answers["refuse"].error == "the scene has no object: add one"
    assert str(answers["surrogate"].error).startswith("there is no ?x")
    assert "ZeroDivisionError" in str(answers["fault"].error)
    assert "cannot be sent" in str(answers["large"].error)
    assert "odd failed" in str(answers["odd"].error)


def test_repeats_are_not_carried_out_twice(opened: Callable[[Any], Any]) -> None:
    done: list[ControlRequest] = []
    server = opened(ReplyServer(ANY, noting(done)))
    client = opened(RequestClient(server.endpoint))
    first = client.request(request(revision=3, payload={"name": "a"}), 30)
    again = client.request(request(revision=3, payload={"name": "a"}), 30)
    renamed = client.request(request(id="r2", revision=3, payload={"name": "a"}), 30)
    assert [control.revision for control in done] == [3]
    assert first == again
    assert (renamed.id, renamed.payload) == ("r2", first.payload)
    older = client.request(request(id="r3", revision=2), 30)
    other = client.request(request(id="r4", revision=3, payload={"name": "b"}), 30)
    assert not older.ok
    assert not other.ok
    assert "send 4 or higher" in str(older.error)
    assert client.request(request(id="r5", revision=4), 30).ok
    assert client.request(request(id="r6", op="other", revision=1), 30).ok
    assert [control.revision for control in done] == [3, 4, 1]


def test_revisions_hold_for_one_scene(opened: Callable[[Any], Any]) -> None:
    done: list[ControlRequest] = []
    server = opened(ReplyServer(ANY, noting(done)))
    client = opened(RequestClient(server.endpoint))
    sent: list[tuple[str | None, int | None]] = [
        ("a", 3),
        ("b", 1),
        ("a", 2),
        (None, 1),
        (None, None),
        (None, 1),
    ]
    for number, (scene_id, revision) in enumerate(sent):
        assert client.request(request(id=f"r{number}", scene_id=scene_id, revision=revision), 30).ok
    assert client.request(request(id="again", revision=1), 30).ok
    assert not client.request(request(id="older", revision=0), 30).ok
    assert [(control.scene_id, control.revision) for control in done] == sent


def test_memory_forgets_old_ids_and_a_refused_revision_may_come_again() -> None:
    memory = ReplyMemory(size=2)
    refused = request(id="a", revision=1)
    memory.remember(refused, ControlReply(node="s", id="a", ok=False, error="no"), 0)
    assert memory.find(request(id="b", revision=1)) is None
    for name in ("b", "c"):
        memory.remember(request(id=name), ControlReply(node="s", id=name, ok=True), 0)
    assert memory.find(refused) is None
    assert memory.find(request(id="c")) is not None


def test_memory_of_long_replies_is_bounded() -> None:
    memory = ReplyMemory()
    for number in range(20):
        name = f"r{number}"
        memory.remember(request(id=name), ControlReply(node="s", id=name, ok=True), 1_000_000)
    kept = [number for number in range(20) if memory.find(request(id=f"r{number}")) is not None]
    assert kept == list(range(4, 20))


def test_a_silent_server_is_named_in_time_and_its_queue_is_forgotten(opened: Callable[[Any], Any]) -> None:
    done: list[ControlRequest] = []
    server = ReplyServer(ANY, noting(done))
    client = opened(RequestClient(server.endpoint))
    assert client.request(request(), 30).ok
    server.close()
    with pytest.raises(DeltalightError, match=r"no answer from tcp://127.0.0.1:\d+ within 0.3 s"):
        client.request(request(id="lost"), 0.3)
    opened(ReplyServer(server.endpoint, noting(done)))
    assert client.request(request(id="found"), 30).ok
    assert [control.id for control in done] == ["r1", "found"]


def test_a_late_answer_does_not_meet_the_next_request(opened: Callable[[Any], Any]) -> None:
    slow = threading.Event()

    def handler(control: ControlRequest) -> dict[str, object]:
        if control.id == "slow":
            slow.wait(30)
        return {"id": control.id}

    server = opened(ReplyServer(ANY, handler))
    client = opened(RequestClient(server.endpoint))
    with pytest.raises(DeltalightError, match="no answer"):
        client.request(request(id="slow"), 0.2)
    slow.set()
    assert client.request(request(id="next"), 30).payload == {"id": "next"}
    assert client.request(request(id="slow"), 30).payload == {"id": "slow"}


def test_closing_twice_is_fine_and_a_closed_client_says_so() -> None:
    server = ReplyServer(ANY, lambda _: {})
    client = RequestClient(server.endpoint)
    for resource in (client, client, server, server):
        resource.close()
    with pytest.raises(DeltalightError, match="is closed"):
        client.request(request(), 1)


def test_threads_may_share_a_client(opened: Callable[[Any], Any]) -> None:
    server = opened(ReplyServer(ANY, lambda control: {"id": control.id}))
    client = opened(RequestClient(server.endpoint))
    answers: list[ControlReply] = []

    def ask(name: str) -> None:
        answers.extend(client.request(request(id=f"{name}{i}"), 10) for i in range(20))

    threads = [threading.Thread(target=ask, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert len(answers) == 80
    assert all(answer.payload == {"id": answer.id} for answer in answers)


@pytest.mark.parametrize(
    "pieces",
    [
        [b""],
        [b"request.a", b"\xc1"],
        encode(StatsMessage(node="a", capture_ns=0, state="running")),
        [b"x"] * 30,
    ],
)
def test_malformed_requests_get_a_sentence(opened: Callable[[Any], Any], pieces: list[bytes]) -> None:
    server = opened(ReplyServer(ANY, lambda _: {}))
    context = open_context()
    try:
        socket = context.socket(zmq.REQ)
        socket.connect(server.endpoint)
        socket.send_multipart(pieces)
        assert socket.poll(5000)
        reply, _ = decode(socket.recv_multipart())
    finally:
        context.destroy(0)
    assert isinstance(reply, ControlReply)
    assert (reply.id, reply.ok) == ("unreadable", False)
    assert opened(RequestClient(server.endpoint)).request(request(), 5).ok


@contextmanager
def answering(answers: Callable[[list[bytes]], list[bytes]]) -> Iterator[str]:
    """Yields the endpoint of a socket that answers as a server of another version would."""
    context = open_context()
    socket = context.socket(zmq.REP)
    port = socket.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        with suppress(zmq.ContextTerminated):
            while True:
                socket.send_multipart(answers(socket.recv_multipart()))
        socket.close(0)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        context.term()
        thread.join(5)


def test_a_server_of_the_version_before_is_asked_in_it(opened: Callable[[Any], Any]) -> None:
    asked = []

    def answer(pieces: list[bytes]) -> list[bytes]:
        read, _ = decode(pieces)
        assert isinstance(read, ControlRequest)
        asked.append(read.schema_version)
        older = {"node": "s", "schema_version": OLDEST_SCHEMA_VERSION}
        if read.schema_version != OLDEST_SCHEMA_VERSION:
            refused = {"id": "unreadable", "ok": False, "error": "another version"}
            return encode(ControlReply.model_validate(older | refused))
        return encode(ControlReply.model_validate(older | {"id": read.id, "ok": True}))

    with answering(answer) as endpoint:
        client = opened(RequestClient(endpoint))
        assert client.request(request(), 5).ok
        assert client.request(request(), 5).ok
        client.close()
    assert asked == [SCHEMA_VERSION, OLDEST_SCHEMA_VERSION, OLDEST_SCHEMA_VERSION]


def test_a_client_of_the_version_before_is_answered_in_it(opened: Callable[[Any], Any]) -> None:
    def handle(control: ControlRequest) -> dict[str, object]:
        if control.op == "refuse":
            raise DeltalightError("not now")
        return {"long": "x" * 100_000} if control.op == "long" else {}

    server = opened(ReplyServer(ANY, handle))
    context = open_context()
    socket = context.socket(zmq.REQ)
    socket.connect(server.endpoint)
    for op in ("ping", "refuse", "long"):
        socket.send_multipart(encode(request(id=op, op=op, schema_version=OLDEST_SCHEMA_VERSION)))
        assert socket.poll(5000)
        reply, _ = decode(socket.recv_multipart())
        assert reply.schema_version == OLDEST_SCHEMA_VERSION
    context.destroy(0)


@pytest.mark.parametrize(
    "answer",
    [
        [b"nonsense"],
        encode(ControlReply(node="s", id="other", ok=True)),
        encode(ControlReply(node="s", id="unreadable", ok=False, error="version 2")),
        encode(StatsMessage(node="a", capture_ns=0, state="running")),
    ],
)
def test_a_foreign_answer_is_refused(opened: Callable[[Any], Any], answer: list[bytes]) -> None:
    context = open_context()
    socket = context.socket(zmq.REP)
    port = socket.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        socket.recv_multipart()
        socket.send_multipart(answer)

    thread = threading.Thread(target=serve)
    thread.start()
    client = opened(RequestClient(f"tcp://127.0.0.1:{port}"))
    try:
        with pytest.raises(EnvelopeError):
            client.request(request(), 30)
    finally:
        thread.join(30)
        context.destroy(0)
