"""Streams over real sockets on loopback: newest wins, slow consumers, lost peers, refused endpoints."""

import gc
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zmq

from deltalight.protocol import receiver as receiver_module
from deltalight.protocol.envelope import decode, encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import MAX_PART_BYTES, StatsMessage
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import ReplyServer, RequestClient
from deltalight.protocol.sockets import check_endpoint, open_context
from deltalight.protocol.subscriber import ReceivedMultipart

ANY = "tcp://127.0.0.1:0"
SETTLE_S = 30.0


def connected(publisher: Publisher, receiver: Receiver, topic: str = "hello") -> None:
    """Waits until a subscription has arrived at the publisher."""
    deadline = time.monotonic() + SETTLE_S
    while time.monotonic() < deadline:
        publisher.send([topic.encode(), b""])
        if receiver.latest(0.05):
            time.sleep(0.05)
            receiver.latest(0)
            return
    raise AssertionError("the subscriber never heard the publisher")


def all_of(receiver: Receiver, wanted: set[str]) -> dict[str, Any]:
    """What arrives until every wanted topic did."""
    got: dict[str, Any] = {}
    deadline = time.monotonic() + SETTLE_S
    while not wanted <= set(got) and time.monotonic() < deadline:
        got.update(receiver.latest(0.2) or {})
    return got


def test_a_message_comes_through_with_its_arrival_time(opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY))
    receiver = opened(Receiver([publisher.endpoint], ["stats", "hello"]))
    connected(publisher, receiver)
    message = StatsMessage(node="desk", capture_ns=time.time_ns(), state="running")
    publisher.send(encode(message))
    got = receiver.latest(SETTLE_S)
    assert got is not None
    assert decode(got["stats.desk"]) == (message, [])
    assert message.capture_ns <= got["stats.desk"].received_ns <= time.time_ns()
    assert receiver.latest(0.01) is None


def test_newest_wins_and_the_others_are_counted(opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY))
    receiver = opened(Receiver([publisher.endpoint], []))
    connected(publisher, receiver)
    before = receiver.drops.get("color.a", 0)
    for i in range(12):
        publisher.send([b"color.a", b"%d" % i])
        time.sleep(0.005)
    publisher.send([b"pose.a", b"last"])
    deadline = time.monotonic() + SETTLE_S
    while receiver.drops.get("color.a", 0) < before + 11 and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.05)
    got = receiver.latest(SETTLE_S)
    assert got is not None
    assert bytes(got["color.a"][1]) == b"11"
    assert bytes(got["pose.a"][1]) == b"last"
    assert receiver.drops == {"color.a": 11}


def test_a_row_of_messages_for_one_frame_is_not_torn(opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY))
    receiver = opened(Receiver([publisher.endpoint], []))
    connected(publisher, receiver)
    streams = [b"color", b"depth", b"clean_depth", b"fisheye", b"radiance"]
    streams += [b"lights", b"pose", b"lamps", b"stats"]
    for i in range(15):
        time.sleep(1 / 60)
        for stream in streams:
            publisher.send([stream + b".a", b"%d" % i, bytes(900_000 if stream == b"color" else 1000)])
        got = all_of(receiver, {f"{stream.decode()}.a" for stream in streams})
        assert [bytes(got[f"{stream.decode()}.a"][1]) for stream in streams] == [b"%d" % i] * len(streams)


def test_topics_are_whole_names_and_not_prefixes(opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY))
    receiver = opened(Receiver([publisher.endpoint], ["color.a", "pose", "lamps", "stats", "hello"]))
    connected(publisher, receiver)
    wanted = {"color.a", "pose.x", "lamps.a", "stats.a"}
    for topic in ["color.ab", "posed.x", "depth.a", *wanted]:
        publisher.send([topic.encode(), b""])
    assert set(all_of(receiver, wanted)) == wanted
    assert receiver.refused == 2


def test_topics_without_end_and_broken_topics_take_no_memory(opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY, streams=1000))
    receiver = opened(Receiver([publisher.endpoint], []))
    connected(publisher, receiver)
    for i in range(400):
        publisher.send([b"color.%d" % i, b""])
    publisher.send([b"\xff\xfe", b""])
    publisher.send([b"x" * 4000, b""])
    publisher.send([b"color.0", *[b""] * 40])
    deadline = time.monotonic() + SETTLE_S
    while receiver.refused < 145 + 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert receiver.refused == 145 + 3  # 256 topics, one of them the greeting
    got = receiver.latest(0)
    assert got is not None
    assert len(got) == 255


def test_large_messages_of_many_topics_take_no_memory_without_end(
    opened: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receiver_module, "MAX_WAITING_BYTES", 10_000)
    receiver = opened(Receiver([ANY], ["color"], bind=True))
    for _ in range(2):  # what is taken makes room again
        for topic in (b"color.a", b"color.a", b"color.b", b"color.c"):
            receiver._store(ReceivedMultipart([memoryview(topic), memoryview(bytes(4500))], 0))
        assert set(receiver.latest(0) or {}) == {"color.a", "color.b"}
    assert receiver.refused == 2
    assert receiver.drops == {"color.a": 2}


def test_a_waiting_consumer_is_woken_by_a_message_and_by_closing(opened: Callable[[Any], Any]) -> None:
    publisher = opened(Publisher(ANY))
    receiver = Receiver([publisher.endpoint], [])
    connected(publisher, receiver)
    woken: list[Any] = []
    waiter = threading.Thread(target=lambda: woken.extend([receiver.latest(30), receiver.latest(30)]))
    waiter.start()
    publisher.send([b"color.a", b"1"])
    deadline = time.monotonic() + SETTLE_S
    while receiver.latest(0) is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.1)
    receiver.close()
    waiter.join(SETTLE_S)
    assert not waiter.is_alive()
    assert woken[-1] is None
    assert receiver.latest(SETTLE_S) is None


def test_many_publishers_and_a_receiver_that_listens(opened: Callable[[Any], Any]) -> None:
    receiver = opened(Receiver([ANY], [], bind=True))
    nodes = [opened(Publisher(receiver.endpoints[0], bind=False)) for _ in range(3)]
    for i, node in enumerate(nodes):
        connected(node, receiver, f"hello.{i}")
    for i, node in enumerate(nodes):
        node.send([b"color.%d" % i, b""])
    assert set(all_of(receiver, {"color.0", "color.1", "color.2"})) == {"color.0", "color.1", "color.2"}


def test_a_stream_returns_after_its_publisher_did(opened: Callable[[Any], Any]) -> None:
    first = Publisher(ANY)
    receiver = opened(Receiver([first.endpoint], []))
    connected(first, receiver)
    first.close()
    second = opened(Publisher(first.endpoint))
    connected(second, receiver)


def test_what_is_too_large_or_closed_is_said() -> None:
    publisher = Publisher(ANY)
    with pytest.raises(DeltalightError, match="allowed"):
        publisher.send([b"color.a", b"", memoryview(bytes(MAX_PART_BYTES + 1))])
    publisher.close()
    with pytest.raises(DeltalightError, match="closed"):
        publisher.send([b"color.a", b""])


def test_a_context_that_is_forgotten_stays_and_one_that_was_ended_goes() -> None:
    """A finalizer of the former would wait for its sockets, which are collected with it, for ever."""
    forgotten = weakref.ref(open_context())
    gc.collect()
    context = forgotten()
    assert context is not None
    context.term()
    del context
    open_context().term()
    gc.collect()
    assert forgotten() is None


def test_an_oversize_piece_does_not_reach_the_mailbox(opened: Callable[[Any], Any]) -> None:
    """The largest that is allowed comes through; whoever sends more is cut off."""
    context = open_context()
    socket = context.socket(zmq.PUB)
    cut_off = socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    receiver = opened(Receiver([f"tcp://127.0.0.1:{port}"], []))
    try:
        deadline = time.monotonic() + SETTLE_S
        while not receiver.latest(0.05) and time.monotonic() < deadline:
            socket.send(b"hello")
        socket.send_multipart([b"color.largest", bytes(MAX_PART_BYTES)])
        assert "color.largest" in all_of(receiver, {"color.largest"})
        socket.send_multipart([b"color.a", bytes(MAX_PART_BYTES + 1)])
        assert cut_off.poll(round(1000 * SETTLE_S))
        assert receiver.latest(0) is None
    finally:
        context.destroy(0)


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp://127.0.0.1:5000",
        "tcp://127.8.9.1:*",
        "tcp://localhost:0",
        "tcp://[::1]:5000",
        "ipc:///run/deltalight.sock",
    ],
)
def test_endpoints_on_this_host_are_allowed(endpoint: str) -> None:
    check_endpoint(endpoint)


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp://0.0.0.0:5000",
        "tcp://*:5000",
        "tcp://192.168.1.5:5000",
        "tcp://example.org:5000",
        "tcp://127.0.0.1.example.org:5000",
        "tcp://[::]:5000",
        "tcp://eth0:5000",
        "tcp://eth0;127.0.0.1:5000",
    ],
)
def test_endpoints_that_leave_the_host_are_refused(endpoint: str) -> None:
    for build in (
        lambda: Publisher(endpoint),
        lambda: Receiver([endpoint], []),
        lambda: RequestClient(endpoint),
    ):
        with pytest.raises(DeltalightError, match="is reachable from other hosts"):
            build()


@pytest.mark.parametrize(
    "endpoint",
    ["", "127.0.0.1:5000", "udp://127.0.0.1:5000", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "inproc://a"],
)
def test_what_is_no_endpoint_is_refused(endpoint: str) -> None:
    with pytest.raises(DeltalightError, match="not an endpoint"):
        check_endpoint(endpoint)


def test_a_taken_port_is_named(opened: Callable[[Any], Any]) -> None:
    endpoint = opened(Publisher(ANY)).endpoint
    with pytest.raises(DeltalightError, match=f"cannot listen at {endpoint}"):
        Publisher(endpoint)
    with pytest.raises(DeltalightError, match=f"cannot listen at {endpoint}"):
        ReplyServer(endpoint, lambda _: {})


# the slow consumer

PUBLISH = """
import sys, time
import numpy as np
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import ColorMessage
from deltalight.protocol.publisher import Publisher

publisher = Publisher("tcp://127.0.0.1:0")
print(publisher.endpoint, flush=True)
pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
due = time.monotonic()
for frame_id in range(100_000):
    message = ColorMessage(node="desk", frame_id=frame_id, capture_ns=time.time_ns(), encoding="raw",
                           shape=(480, 640, 3), camera={})
    publisher.send(encode(message, [pixels]))
    due += 1 / 30
    time.sleep(max(0.0, due - time.monotonic()))
"""


@pytest.mark.slow
def test_a_consumer_ten_times_too_slow_gets_fresh_frames_and_keeps_its_memory(
    opened: Callable[[Any], Any],
) -> None:
    period_s, rounds = 0.33, 17
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", PUBLISH], cwd=root, stdout=subprocess.PIPE, text=True
    ) as sender:
        try:
            assert sender.stdout is not None
            receiver = opened(Receiver([sender.stdout.readline().strip()], ["color"]))
            assert receiver.latest(SETTLE_S) is not None
            here, there = psutil.Process(), psutil.Process(sender.pid)
            ages_s, ids, memory = [], [], [(here.memory_info().rss, there.memory_info().rss)]
            for _ in range(rounds):
                time.sleep(period_s)
                got = receiver.latest(SETTLE_S)
                assert got is not None
                message, parts = decode(got["color.desk"])
                ages_s.append((time.time_ns() - message.capture_ns) / 1e9)
                ids.append(message.frame_id)
                assert len(parts[0]) == 480 * 640 * 3
                memory.append((here.memory_info().rss, there.memory_info().rss))
            drops = receiver.drops["color.desk"]
        finally:
            sender.kill()
    assert np.median(ages_s) < 1.5 * period_s  # those of a queue would grow to seconds
    assert np.all(np.diff(ids) > 0)
    assert np.ptp(np.array(memory), axis=0).max() < 50e6
    # What was not taken was counted: the numbers account for all frames between the first and the last one.
    assert drops >= 3 * rounds
    assert drops + len(ids) == pytest.approx(ids[-1] - ids[0] + 1, rel=0.2, abs=12)
