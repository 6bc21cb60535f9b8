"""Peers that flood a socket and hang up: the process lives on. Each socket is in a process that may abort."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.payloads import encode_control
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
