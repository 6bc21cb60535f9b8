"""The supervisor with real child processes: restart, giving up, wrong input, no orphans."""

import os
import pkgutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.supervisor import Supervisor
from deltalight.services.warm_spare import PREPARED, SPARE_VARIABLE
from tests.protocol.raw_peers import PING, RawPeer, multipart

PATIENCE_S = 60.0
SLEEP_FOREVER = "import time\nwhile True: time.sleep(60)"
IGNORE_SIGTERM = f"import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n{SLEEP_FOREVER}"


def python(name: str, code: str) -> ChildSpec:
    return ChildSpec(name, ("-c", code))


def poll_until(supervisor: Supervisor, condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    supervisor.run(until=lambda: condition() or time.monotonic() > deadline_s)
    assert condition()


def test_killed_child_is_started_again_and_the_other_left_alone() -> None:
    lines: list[str] = []
    with Supervisor(
        [python("a", SLEEP_FOREVER), python("b", SLEEP_FOREVER)], forward=lines.append
    ) as supervisor:
        before = supervisor.process_ids()
        psutil.Process(before["a"]).kill()
        poll_until(supervisor, lambda: supervisor.restarts()["a"] == 1)
        after = supervisor.process_ids()
        assert after["a"] != before["a"]
        assert after["b"] == before["b"]
        assert psutil.pid_exists(after["a"])
    assert any("a: died with exit code -9" in line for line in lines)


RECEIVER = """
import sys, time, zmq
from deltalight.protocol.sockets import attach, open_socket

socket = open_socket(zmq.Context(), zmq.SUB)
socket.subscribe("")
attach(socket, sys.argv[1], bind=True)
while True:
    time.sleep(0.05)  # its queue is full meanwhile
    print(socket.recv_multipart()[0].decode(), file=sys.stderr, flush=True)
"""


@pytest.mark.slow
def test_a_child_that_libzmq_aborts_receives_again() -> None:
    """libzmq 4.3.5 aborts at heartbeats among more messages than a queue takes, of a peer that has hung up."""
    (port,) = ports.private_ports(1)
    lines: list[str] = []
    spec = ChildSpec("receiver", ("-c", RECEIVER, ports.endpoint(port)))
    with Supervisor([spec], forward=lines.append) as supervisor:
        poll_until(supervisor, lambda: ports.answers(port), PATIENCE_S)
        peer = RawPeer(port, "PUB").wait_until_ready()
        peer.send_what_fits((multipart([b"flood", bytes(600)]) + PING) * 4000)
        poll_until(supervisor, lambda: any(line.endswith("flood") for line in lines), PATIENCE_S)
        peer.hang_up()
        poll_until(supervisor, lambda: supervisor.restarts()["receiver"] == 1, PATIENCE_S)
        poll_until(supervisor, lambda: ports.answers(port), PATIENCE_S)
        later = RawPeer(port, "PUB").wait_until_ready()
        later.send_what_fits(multipart([b"after", b""]))
        poll_until(supervisor, lambda: any(line.endswith("after") for line in lines), PATIENCE_S)
        later.hang_up()
    assert any("receiver: died with exit code -6" in line for line in lines)


def test_child_that_keeps_dying_is_given_up_with_its_last_line() -> None:
    code = "import sys; sys.exit('the lamp is broken')"
    with (
        Supervisor([python("lamp", code)], forward=lambda _line: None, maximum_restarts=2) as supervisor,
        pytest.raises(DeltalightError, match=r"lamp died 3 times within a minute.*the lamp is broken"),
    ):
        supervisor.run()
    assert supervisor.restarts()["lamp"] == 2


def test_child_that_refuses_its_input_is_not_started_again() -> None:
    code = "import sys; print('deltalight: The scene is wrong; mend it.', file=sys.stderr); sys.exit(2)"
    with (
        Supervisor([python("server", code)], forward=lambda _line: None) as supervisor,
        pytest.raises(DeltalightError, match=r"^The scene is wrong; mend it\.$"),
    ):
        supervisor.run()
    assert supervisor.restarts()["server"] == 0


def test_child_that_ends_well_is_not_started_again() -> None:
    lines: list[str] = []
    with Supervisor([python("node", "pass"), python("b", SLEEP_FOREVER)], forward=lines.append) as supervisor:
        poll_until(supervisor, lambda: "node" not in supervisor.process_ids())
        supervisor.poll()
        assert supervisor.restarts() == {"node": 0, "b": 0}
    assert "node: ended by itself." in lines


def test_stop_ends_even_a_child_that_ignores_sigterm() -> None:
    supervisor = Supervisor([python("stubborn", IGNORE_SIGTERM), python("kind", SLEEP_FOREVER)])
    with supervisor:
        time.sleep(0.5)
        ids = supervisor.process_ids()
        started_s = time.monotonic()
    assert time.monotonic() - started_s < 10  # bounded, not measured
    assert not any(psutil.pid_exists(number) for number in ids.values())


def test_children_end_when_the_supervisor_is_killed(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    child = (
        "import os, time, pathlib; from deltalight.services.parent_death_signal import end_with_supervisor;"
        "end_with_supervisor();"
        f"pathlib.Path({str(pid_file)!r}).write_text(str(os.getpid())); time.sleep(600)"
    )
    parent = (
        "from deltalight.services.child import ChildSpec\n"
        "from deltalight.services.supervisor import Supervisor\n"
        f"with Supervisor([ChildSpec('child', ('-c', {child!r}))]) as supervisor: supervisor.run()"
    )
    process = subprocess.Popen([sys.executable, "-c", parent])
    deadline_s = time.monotonic() + 20
    while not (pid_file.exists() and pid_file.read_text()) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    orphan = psutil.Process(int(pid_file.read_text()))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert psutil.wait_procs([orphan], timeout=10)[1] == []


WARM_CHILD = """
import os, sys, time
from deltalight.services.warm_spare import wait_if_spare
wait_if_spare(lambda words: 0)
print("runs with", "colorsys" in sys.modules, repr(sys.stdin.read()), file=sys.stderr, flush=True)
while True: time.sleep(60)
"""


def test_a_spare_takes_the_place_of_a_process_that_dies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.services.child.SPARE_AFTER_S", 0.0)
    lines: list[str] = []
    spec = ChildSpec("a", ("-c", WARM_CHILD), warm=("colorsys",))
    with Supervisor([spec], forward=lines.append) as supervisor:
        poll_until(supervisor, lambda: bool(supervisor.spare_ids()) and "a: runs with False ''" in lines)
        first, spare = supervisor.process_ids()["a"], supervisor.spare_ids()["a"]
        psutil.Process(first).kill()
        poll_until(supervisor, lambda: supervisor.process_ids()["a"] == spare)
        poll_until(supervisor, lambda: "a: runs with True ''" in lines)
        poll_until(supervisor, lambda: "a" in supervisor.spare_ids())
        another = supervisor.spare_ids()["a"]
        assert another not in {first, spare}
    assert not any(psutil.pid_exists(number) for number in (first, spare, another))


REHEARSING_CHILD = """
import sys
from deltalight.services.warm_spare import this_spare, wait_if_spare

def run(words):
    spare = this_spare()
    if spare.is_rehearsing:
        spare.prepared = f"rehearsed {words}, called: {spare.is_called(60.0)};"
    elif spare.prepared:
        print(spare.prepared, "runs", words, file=sys.stderr, flush=True)
    return 0

wait_if_spare(run)
if this_spare() is not None:
    run(sys.argv[1:])
import time
while True: time.sleep(60)
"""


def test_a_spare_rehearses_its_command_until_it_is_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.services.child.SPARE_AFTER_S", 0.0)
    lines: list[str] = []
    spec = ChildSpec("a", ("-P", "-c", REHEARSING_CHILD, "sing"), warm=("colorsys",), rehearsed=True)
    with Supervisor([spec], forward=lines.append) as supervisor:
        poll_until(supervisor, lambda: "a" in supervisor.spare_ids())
        psutil.Process(supervisor.process_ids()["a"]).kill()
        poll_until(supervisor, lambda: any("runs ['sing']" in line for line in lines))
    assert "a: rehearsed ['sing'], called: True; runs ['sing']" in lines


def test_a_dead_spare_is_nobodys_replacement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.services.child.SPARE_AFTER_S", 0.0)
    spec = ChildSpec("a", ("-c", WARM_CHILD), warm=("no_such_module",))
    with Supervisor([spec], forward=lambda _line: None) as supervisor:
        poll_until(supervisor, lambda: bool(supervisor.spare_ids()))
        first, spare = supervisor.process_ids()["a"], supervisor.spare_ids()["a"]
        poll_until(supervisor, lambda: psutil.Process(spare).status() == psutil.STATUS_ZOMBIE)
        psutil.Process(first).kill()
        poll_until(supervisor, lambda: supervisor.restarts()["a"] == 1)
        assert supervisor.process_ids()["a"] not in {first, spare}


class Starting:
    """Watches a process that does not do yet what it is for."""

    def __init__(self, _process_id: int) -> None:
        self.has_started = False

    def fault(self) -> None:
        return None

    def is_starting(self) -> bool:
        return not self.has_started

    def close(self) -> None:
        pass


def test_spares_wait_for_the_first_picture_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.services.child.SPARE_AFTER_S", 0.0)
    watches: list[Starting] = []

    def watch(process_id: int) -> Starting:
        watches.append(Starting(process_id))
        return watches[-1]

    specs = [
        ChildSpec("a", ("-c", WARM_CHILD), watch),
        ChildSpec("b", ("-c", WARM_CHILD), warm=("colorsys",)),
    ]
    with Supervisor(specs, forward=lambda _line: None) as supervisor:
        supervisor.poll()
        assert not supervisor.spare_ids()
        watches[0].has_started = True
        supervisor.poll()
        assert supervisor.spare_ids().keys() == {"b"}
    monkeypatch.setattr("deltalight.services.child.FIRST_PICTURE_S", 0.0)
    with Supervisor(specs, forward=lambda _line: None) as supervisor:
        supervisor.poll()
        assert supervisor.spare_ids().keys() == {"b"}


FORKS = """
import time
from deltalight.services import cli
from deltalight.services.child import ChildSpec, ending_spares, fork_spares
from deltalight.services.supervisor import Supervisor
from deltalight.services.warm_spare import PREPARED

def with_spares(words):
    if words != ["demo"]:
        return run(words)
    lines = []
    with ending_spares(fork_spares({"a": "ping", "b": "ping", "c": "ping"})) as spares:
        print(*[each.pid for each in spares.values()], flush=True)
        SCRIPT
    assert spares["b"].poll() is not None
    return 0

PREPARED["ping"] = ()
run, cli.run = cli.run, with_spares
cli.main()
"""
BECOME_CHILDREN = """
        specs = [ChildSpec.deltalight("a", "ping", "--help"), ChildSpec.deltalight("c", "ping", "--nonsense")]
        with Supervisor(specs, forward=lines.append, spares=spares) as supervisor:
            assert supervisor.process_ids() == {"a": spares["a"].pid, "c": spares["c"].pid}
            assert (spares["a"].wait(timeout=60), spares["c"].wait(timeout=60)) == (0, 2)
        assert any("--nonsense" in line for line in lines)
        assert spares["b"].poll() is None
"""


def forking(script: str) -> "subprocess.Popen[str]":
    """Python that forks three spares, prints their ids, and runs a part of a script while they wait."""
    code = FORKS.replace("SCRIPT", script.strip())
    return subprocess.Popen([sys.executable, "-c", code, "demo"], stdout=subprocess.PIPE, text=True)


def test_early_spares_become_the_first_processes_and_others_end() -> None:
    with forking(BECOME_CHILDREN) as process:
        assert process.wait(timeout=PATIENCE_S) == 0


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems start early spares")
def test_forked_spares_end_with_their_killed_supervisor() -> None:
    with forking("time.sleep(60)") as process:
        assert process.stdout is not None
        spares = [psutil.Process(int(word)) for word in process.stdout.readline().split()]
        assert all(psutil.Process(process.pid) == each.parent() for each in spares)
        process.kill()
    assert psutil.wait_procs(spares, timeout=PATIENCE_S)[1] == []


def test_a_spare_ends_with_its_supervisor() -> None:
    waiting = subprocess.Popen(
        [sys.executable, "-c", WARM_CHILD], stdin=subprocess.PIPE, env={**os.environ, SPARE_VARIABLE: ""}
    )
    assert waiting.stdin is not None
    waiting.stdin.close()
    assert waiting.wait(timeout=60) == 0


def test_all_that_spares_prepare_is_there() -> None:
    for names in PREPARED.values():
        for name in names:
            assert pkgutil.resolve_name(name)
