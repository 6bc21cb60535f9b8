"""Peers that flood a socket and hang up: the process lives on. Each socket is in a process that may abort."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager

import pytest

from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.payloads import encode_control
from deltalight.protocol.request import RequestClient
from tests.protocol.raw_peers import RawPeer, multipart

# Both take nothing until they are told to, so that queues are full for longer than libzmq's timers take.
ANSWERING = """
import sys, threading
from deltalight.protocol.request import ReplyServer

gate = threading.Event()

def answer(request):
    gate.wait()
    return {}

server = ReplyServer("tcp://127.0.0.1:0", answer)
print(server.endpoint.rpartition(":")[2], flush=True)
sys.stdin.readline()
gate.set()
server.close()
"""
RECEIVING = """
import sys, zmq
from deltalight.protocol.sockets import attach, open_socket

socket = open_socket(zmq.Context(), zmq.SUB)
socket.subscribe("")
print(attach(socket, "tcp://127.0.0.1:0", bind=True).rpartition(":")[2], flush=True)
sys.stdin.readline()
while socket.poll(200):
    socket.recv_multipart()
"""
FEW_FILES = """
import resource, sys
from deltalight.protocol import sockets
from deltalight.protocol.request import ReplyServer

resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
sockets.HANDSHAKE_MS = 500

def answer(request):
    with open("/dev/null"):
        return {}

server = ReplyServer("tcp://127.0.0.1:0", answer)
print(server.endpoint.rpartition(":")[2], flush=True)
sys.stdin.readline()
server.close()
"""
PEERS = 4
REQUEST = multipart(
    [
        b"",
        *encode_control(ControlRequest(node="x", capture_ns=0, id="1", op="ping", payload={"x": "y" * 900})),
    ]
)


@contextmanager
def process(script: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", script], stdin=pipe, stdout=pipe, text=True) as child:
        assert child.stdout is not None
        yield child, int(child.stdout.readline())


@pytest.mark.parametrize(
    ("script", "kind", "flood"),
    [(ANSWERING, "DEALER", REQUEST), (RECEIVING, "PUB", multipart([b"color.x", bytes(4000)]))],
    ids=["answers", "receives"],
)
def test_who_floods_and_hangs_up_ends_no_process(script: str, kind: str, flood: bytes) -> None:
    with process(script) as (child, port):
        peers = [RawPeer(port, kind) for _ in range(PEERS)]
        for peer in peers:
            peer.send_what_fits(flood * 20_000)
        for peer in peers:
            peer.hang_up()
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(1.5)  # longer than a heartbeat
        child.communicate("\n")
        assert child.returncode == 0


def test_who_connects_and_says_nothing_takes_nobody_s_place_for_long() -> None:
    """Not even all of a process's open files, without which it answers nobody and its log cannot be written."""
    with ExitStack() as stack:
        child, port = stack.enter_context(process(FEW_FILES))
        known = stack.enter_context(closing(RequestClient(f"tcp://127.0.0.1:{port}")))
        assert known.request(ControlRequest(node="x", id="1", op="ping"), 10).ok
        for _ in range(80):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
        deadline = time.monotonic() + 20
        while not known.request(ControlRequest(node="x", id=f"2-{time.monotonic_ns()}", op="ping"), 10).ok:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        other = stack.enter_context(closing(RequestClient(f"tcp://127.0.0.1:{port}")))
        assert other.request(ControlRequest(node="x", id="3", op="ping"), 20).ok
        child.communicate("\n")
