"""Workers that are forked: each is alone with its file, and none is missing because of what became of another."""

import json
import os
import select
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from deltalight.services.storage import asset_sandbox, asset_worker
from deltalight.services.storage.asset_sandbox import ONE_THREAD, WORKER, probe, run_limited
from deltalight.services.storage.faults import RejectedAssetError
from deltalight.services.storage.worker_forks import WorkerForks
from tests.services.storage_samples import TETRAHEDRON

pytestmark = pytest.mark.skipif(not asset_sandbox.CAN_FORK, reason="only Linux forks safely")


@pytest.fixture
def forks(monkeypatch: pytest.MonkeyPatch) -> Iterator[WorkerForks]:
    """Of this test alone."""
    made = WorkerForks(WORKER, ONE_THREAD)
    monkeypatch.setattr(asset_sandbox, "_forks", made)
    yield made
    made.close()


def forking(forks: WorkerForks) -> psutil.Process:
    assert forks._process is not None
    return psutil.Process(forks._process.pid)


@pytest.mark.parametrize("can_fork", [True, False])
def test_a_worker_tells_what_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, can_fork: bool
) -> None:
    monkeypatch.setattr(asset_sandbox, "CAN_FORK", can_fork)
    (tmp_path / "cup.obj").write_bytes(TETRAHEDRON)
    (tmp_path / "bad.obj").write_text("v 1 2 nonsense")
    assert probe(tmp_path / "cup.obj", "mesh", "cup.obj")["triangles"] == 4
    with pytest.raises(RejectedAssetError, match=r"^bad\.obj "):
        probe(tmp_path / "bad.obj", "mesh", "bad.obj")


def test_workers_read_files_where_their_caller_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / f"{name}.obj").write_bytes(TETRAHEDRON)
        monkeypatch.chdir(folder)
        assert probe(Path(f"{name}.obj"), "mesh", "cup.obj")["triangles"] == 4


def test_one_process_forks_all_workers_and_another_comes_where_it_was_killed(
    forks: WorkerForks, tmp_path: Path
) -> None:
    path = tmp_path / "cup.obj"
    path.write_bytes(TETRAHEDRON)
    facts = probe(path, "mesh", "cup.obj")
    first = forking(forks)
    assert probe(path, "mesh", "cup.obj") == facts
    assert forking(forks) == first
    first.kill()
    psutil.wait_procs([first])
    assert probe(path, "mesh", "cup.obj") == facts
    assert forking(forks) != first


def test_a_forking_process_that_ended_leaves_no_zombie(forks: WorkerForks, tmp_path: Path) -> None:
    (tmp_path / "cup.obj").write_bytes(TETRAHEDRON)
    probe(tmp_path / "cup.obj", "mesh", "cup.obj")
    ended = forking(forks)
    os.kill(ended.pid, signal.SIGKILL)
    until_s = time.monotonic() + 60
    while psutil.pid_exists(ended.pid):
        assert time.monotonic() < until_s, "nobody waits for it"
        time.sleep(0.02)


def test_a_worker_that_takes_too_long_ends_and_others_go_on(forks: WorkerForks, tmp_path: Path) -> None:
    endless, path = tmp_path / "endless.hdr", tmp_path / "cup.obj"
    os.mkfifo(endless)  # nobody writes
    path.write_bytes(TETRAHEDRON)
    with pytest.raises(RejectedAssetError, match=r"^big\.zip takes longer than 1 s to load; simplify it\.$"):
        run_limited("unzip", endless, "big.zip", str(tmp_path / "out"), "1000", time_s=1)
    assert probe(path, "mesh", "cup.obj")["triangles"] == 4
    _, left = psutil.wait_procs(forking(forks).children(), timeout=60)
    assert left == []


def test_the_process_that_forks_ends_with_whom_it_works_for(forks: WorkerForks, tmp_path: Path) -> None:
    (tmp_path / "cup.obj").write_bytes(TETRAHEDRON)
    probe(tmp_path / "cup.obj", "mesh", "cup.obj")
    process = forking(forks)
    forks.close()  # as the kernel does at a process's end
    assert not process.is_running()


@pytest.mark.parametrize("is_asked", [False, True])
def test_after_a_while_without_work_it_ends_and_loses_no_request(
    monkeypatch: pytest.MonkeyPatch, *, is_asked: bool
) -> None:
    ours, theirs = socket.socketpair(type=socket.SOCK_SEQPACKET)
    forked: list[bool] = []

    def wait(*_arguments: object) -> tuple[list[socket.socket], ...]:
        if is_asked and not forked:  # in the moment in which it decides to end
            request = json.dumps(["/", "map", "a.hdr", "1", "1", "0"]).encode()
            socket.send_fds(ours, [request], [ours.fileno()])
        return [], [], []

    def fork() -> int:
        forked.append(True)
        return os.getpid()

    monkeypatch.setattr(select, "select", wait)
    monkeypatch.setattr(asset_worker, "_prepare", lambda *_words: None)
    monkeypatch.setattr(os, "fork", fork)
    with ours, theirs:
        asset_worker._fork_workers(theirs)
        assert forked == [True] * is_asked
        with pytest.raises(BrokenPipeError):
            ours.send(b"who comes later is told")


def test_a_worker_that_crashes_is_said_to(forks: WorkerForks, tmp_path: Path) -> None:
    endless = tmp_path / "endless.zip"
    os.mkfifo(endless)  # nobody writes
    with ThreadPoolExecutor() as pool:
        running = pool.submit(run_limited, "unzip", endless, "cup.zip", str(tmp_path / "out"), "1000")
        while not (workers := forks._process is not None and forking(forks).children()):
            time.sleep(0.02)
        workers[0].send_signal(signal.SIGSEGV)
        with pytest.raises(RejectedAssetError, match=r"^cup\.zip crashes the program that loads it"):
            running.result(60)
