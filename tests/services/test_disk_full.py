"""A disk of the kernel's own that is full or read-only, or a limit of files, under `api` and `record`.

What is refused is one sentence, and nothing is half-written.

The disk is a tmpfs of a mount namespace, so it needs a Linux that lets the user make one.
"""

import json
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote
from typing import Any

import cv2
import httpx
import psutil
import pytest

from deltalight.protocol.source import open_source
from deltalight.services import ports
from tests.services.api_samples import sentence
from tests.services.conftest import ROOT, RunCli
from tests.services.live_samples import event_socket, next_event
from tests.services.record_samples import feeding
from tests.services.storage_samples import TETRAHEDRON
from tests.services.test_api_process import wait_for

OWN_MOUNTS = ("unshare", "--user", "--map-root-user", "--mount")
MOUNT = 'mount -t tmpfs -o "size=$0" tmpfs "$1"'
PATIENCE_S, DEMO_PATIENCE_S = 60, 240
OF_DISK = re.compile(
    "cannot grow|takes data again|recording ended"
)  # a busy machine tells of other things, too
BINARY = {"Content-Type": "application/octet-stream"}


def _own_mounts_work() -> bool:
    try:
        return subprocess.run([*OWN_MOUNTS, "true"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not _own_mounts_work(), reason="no mount namespaces may be made here"),
]


def on_small_disk(size: str, disk: Path, script: str, *arguments: object) -> list[str]:
    """The command that runs a shell script with a disk mounted; the script gets the command line in `"$@"`."""
    command = [sys.executable, "-m", "deltalight.services.cli", *map(str, arguments)]
    return [*OWN_MOUNTS, "sh", "-c", f"{MOUNT} && shift && {script}", size, str(disk), *command]


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    folder = tmp_path / "disk"
    folder.mkdir()
    return folder


@contextmanager
def serving(disk: Path, size: str, script: str, *options: str) -> Iterator[tuple[httpx.Client, int]]:
    """A web process that a shell script starts, with its data on a disk of this size; and its process id."""
    (port,) = ports.private_ports(1)
    command = on_small_disk(size, disk, script, "api", "--port", port, "--data", disk / "data", *options)
    with (
        httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1", timeout=PATIENCE_S) as client,
        subprocess.Popen(command, cwd=ROOT) as process,
    ):
        try:
            wait_for(lambda: client.get("/health").is_success)
            yield client, process.pid
        finally:
            process.kill()


@pytest.fixture
def served(disk: Path) -> Iterator[tuple[httpx.Client, Path]]:
    """A web process with its data on a disk of 4 MB, and that disk as the process sees it."""
    with serving(disk, "4m", 'exec "$@"') as (client, process_id):
        yield client, Path(f"/proc/{process_id}/root{disk}")


def upload(client: httpx.Client, name: str, size: int) -> httpx.Response:
    content = TETRAHEDRON + b"#" + secrets.token_hex(size // 2).encode() + b"\n"
    return client.post("/assets", params={"name": name}, content=content, headers=BINARY)


def fill(ballast: Path) -> None:
    with suppress(OSError), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


def test_a_full_disk_refuses_uploads_and_changes_and_goes_on_when_there_is_room(
    served: tuple[httpx.Client, Path],
) -> None:
    client, disk = served
    kept: list[str] = []
    while (answer := upload(client, f"t{len(kept)}.obj", 1_500_000)).is_success:
        kept.append(answer.json()["asset"])
    assert "No space left" in sentence(answer, 503)
    assert kept
    fill(disk / "ballast")
    assert "database or disk is full" in sentence(client.post("/scenes", json={"objects": []}), 503)
    assert "No space left" in sentence(upload(client, "t.obj", 100_000), 503)
    assert {each["asset"] for each in client.get("/assets").raise_for_status().json()} == {*kept}
    names = {path.name for path in (disk / "data" / "assets").iterdir()}
    assert names == {".incoming", *(each.removeprefix("sha256:") for each in kept)}
    assert not list((disk / "data" / "assets" / ".incoming").iterdir())
    (disk / "ballast").unlink()
    client.delete(f"/assets/{kept[0]}").raise_for_status()
    assert client.post("/scenes", json={"objects": []}).status_code == 201
    assert upload(client, "t.obj", 100_000).status_code == 201


def test_files_beyond_what_the_user_may_write_are_refused_and_it_goes_on_once_they_may_be(disk: Path) -> None:
    """As for a quota, the system refuses by another error than that of a full disk: here that of RLIMIT_FSIZE."""
    lamps = [{"type": "sphere", "position_m": [0, 0, 1 + number / 100]} for number in range(64)]
    scene = {"lights": {"manual": lamps}}
    with serving(disk, "32m", 'ulimit -S -f 4096 && exec "$@"') as (client, process_id):  # 2 MB
        assert "File too large" in sentence(upload(client, "large.obj", 3_000_000), 503)
        kept = [upload(client, "small.obj", 100_000).json()["asset"]]
        stored = 0
        while (answer := client.post("/scenes", json=scene)).is_success:
            stored += 1
        assert "The database cannot be used now" in sentence(answer, 503)
        assert [each["asset"] for each in client.get("/assets").raise_for_status().json()] == kept
        before = len(client.get("/scenes").raise_for_status().json())
        psutil.Process(process_id).rlimit(psutil.RLIMIT_FSIZE, (psutil.RLIM_INFINITY, psutil.RLIM_INFINITY))
        assert client.post("/scenes", json=scene).status_code == 201
        assert upload(client, "large.obj", 3_000_000).status_code == 201
        assert len(client.get("/scenes").raise_for_status().json()) == before + 1 > stored > 0


def run_to_its_end(command: list[str], timeout_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s, check=False)


@pytest.mark.slow(seconds=20)
def test_a_headless_demo_on_a_full_disk_ends_and_leaves_whole_files(disk: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    keep = f'"$@"; code=$?; cp -r {quote(str(disk))} {quote(str(kept))}; exit $code'
    options = ("--headless", "--frames", 30, "--method", "paper", "--out", disk)
    done = run_to_its_end(on_small_disk("200k", disk, keep, "demo", *options), DEMO_PATIENCE_S)
    assert done.returncode == 2, done.stderr
    (told,) = (line for line in done.stderr.splitlines() if line.startswith("deltalight: "))
    assert "cannot be written (No space left on device); free some space" in told
    lines = [json.loads(line) for line in (kept / "frames.jsonl").read_text().splitlines()]
    pictures = sorted(kept.glob("*.jpg"))
    assert len(pictures) >= len(lines) > 0
    assert all(cv2.imread(str(path)) is not None for path in pictures)
    assert {path.name for path in kept.iterdir()} == {"frames.jsonl", *(path.name for path in pictures)}


class Take:
    """`record` of a node onto a small disk, from the first frames on; the disk is copied to `kept` at its end."""

    def __init__(self, process: "subprocess.Popen[str]", disk: Path, kept: Path) -> None:
        self.process, self._kept, self._mounted = process, kept, disk
        self.disk = Path(f"/proc/{process.pid}/root{disk}")
        self.until(lambda figures: figures["frames"] > 5)

    @property
    def recorder(self) -> psutil.Process:
        return psutil.Process(self.process.pid).children()[0]

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The first figures from now on that fulfil a condition."""
        assert self.process.stdout is not None
        return next(figures for figures in map(json.loads, self.process.stdout) if condition(figures))

    def refused(self, reason: str) -> int:
        """Waits until the disk refused frames, and sees that the ones before can be read; how many these are."""
        figures = self.until(lambda figures: figures["unkept"] > 0)
        assert (
            f"a.mcap.active cannot grow ({reason}); its {figures['frames']} frames are kept"
            in figures["disk"]
        )
        assert len(open_source(self.disk / "a.mcap.active")) == figures["frames"]
        return int(figures["frames"])

    def mount(self, options: str) -> None:
        inside = ("nsenter", "--user", "--mount", "--target", str(self.process.pid), "mount", "-o", options)
        subprocess.run([*inside, str(self._mounted)], check=True, timeout=PATIENCE_S)

    def end(self) -> tuple[int, dict[str, Any], list[str]]:
        """Stops it; the exit code, the summary if there is one, and what it told of the disk that refuses."""
        self.recorder.send_signal(signal.SIGINT)
        code = self.process.wait(PATIENCE_S)
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        lines = self.process.stdout.read().splitlines()
        told = [line for line in self.process.stderr.read().splitlines() if OF_DISK.search(line)]
        return code, json.loads(lines[-1]) if lines else {}, told

    def goes_on_to_its_end(self, before: int) -> None:
        """Sees that it goes on by itself, and that at its end all frames are there that the disk did not refuse."""
        assert "takes data again" in self.until(lambda figures: figures["frames"] > before + 20)["disk"]
        code, last, told = self.end()
        assert code == 0
        assert [line.split("; ")[1].partition(" ")[0] for line in told] == ["its", str(last["unkept"])]
        (path,) = self._kept.glob("*.mcap*")
        assert path.name == "a.mcap"
        found = [frame.frame_id for frame in open_source(path)]
        assert len(found) == last["frames"]
        lost = last["unkept"] + last["missing"].get("color", 0)  # the latter on a busy machine
        assert found[-1] - found[0] + 1 == last["frames"] + lost


@pytest.fixture
def take(disk: Path, tmp_path: Path) -> Iterator[Take]:
    kept = tmp_path / "kept"
    keep = f'"$@"; code=$?; cp -r {quote(str(disk))} {quote(str(kept))}; exit $code'
    options = ("--progress", "--json", "--out", disk / "a.mcap")
    with feeding() as (endpoint, _):
        command = on_small_disk("16m", disk, keep, "record", *options, "--subscribe", endpoint)
        pipe = subprocess.PIPE
        with subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True) as process:
            try:
                yield Take(process, disk, kept)
            finally:
                for each in psutil.Process(process.pid).children() if process.poll() is None else ():
                    each.kill()


def test_a_recording_that_fills_the_disk_goes_on_when_there_is_room(take: Take) -> None:
    fill(take.disk / "ballast")
    before = take.refused("No space left on device")
    (take.disk / "ballast").unlink()
    take.goes_on_to_its_end(before)


def test_a_recording_at_a_limit_goes_on_when_it_is_lifted(take: Take) -> None:
    """As for a quota, the system refuses in the middle of a frame, here by RLIMIT_FSIZE."""
    size = (take.disk / "a.mcap.active").stat().st_size
    take.recorder.rlimit(psutil.RLIMIT_FSIZE, (size + 100_000, psutil.RLIM_INFINITY))
    before = take.refused("File too large")
    take.recorder.rlimit(psutil.RLIMIT_FSIZE, (psutil.RLIM_INFINITY, psutil.RLIM_INFINITY))
    take.goes_on_to_its_end(before)


def test_a_recording_goes_on_after_its_disk_was_read_only(take: Take) -> None:
    """The system makes no disk read-only while a file is being written there, but the recorder closes its own."""
    fill(take.disk / "ballast")
    before = take.refused("No space left on device")
    take.mount("remount,ro")
    unkept = take.until(lambda _: True)["unkept"]
    figures = take.until(lambda figures: figures["unkept"] > unkept + 100)  # it tried in between
    assert figures["frames"] == before
    take.mount("remount,rw,size=32m")
    take.goes_on_to_its_end(before)


def test_a_recording_that_is_stopped_on_a_full_disk_keeps_its_frames(
    take: Take, tmp_path: Path, cli: RunCli
) -> None:
    fill(take.disk / "ballast")
    before = take.refused("No space left on device")
    code, _, told = take.end()
    assert code == 2
    assert len(told) == 2
    assert f"ended after {before} frames" in told[-1]
    assert "No space left on device" in told[-1]
    assert cli("recordings", "recover", tmp_path / "kept" / "a.mcap.active").returncode == 0
    assert len(open_source(tmp_path / "kept" / "a.mcap")) == before


def test_recordings_of_the_web_process_wait_for_a_full_disk_and_tell_of_it(disk: Path) -> None:
    with (
        feeding() as (endpoint, _),
        serving(disk, "32m", 'exec "$@"', "--subscribe", endpoint) as (client, process_id),
    ):
        ballast = Path(f"/proc/{process_id}/root{disk}/ballast")

        def reach(name: str, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
            state: dict[str, Any] = {}

            def has_come() -> bool:
                state.update(client.get(f"/recordings/{name}").raise_for_status().json())
                return condition(state)

            wait_for(has_come)
            return state

        def record_until_full(name: str) -> dict[str, Any]:
            client.post("/recordings", json={"name": name}).raise_for_status()
            reach(name, lambda take: (take["frames"] or 0) > 5)
            fill(ballast)
            refused = reach(name, lambda take: take["unkept"] > 0)
            assert refused["state"] == "recording"
            frames = f"its {refused['frames']} frames are kept"
            assert f"{name}.mcap.active cannot grow (No space left on device); {frames}" in refused["detail"]
            return refused

        with event_socket(str(client.base_url.netloc, "ascii")) as events:
            before = record_until_full("patient")
            assert next_event(events, "notice")["text"] == before["detail"]
            ballast.unlink()
            assert "takes data again" in next_event(events, "notice")["text"]
        ended = client.post("/recordings/patient/stop").raise_for_status().json()
        assert ended["state"] == "finished"
        assert f"{ended['unkept']} frames could not be kept" in ended["detail"]
        assert ended["unkept"] >= before["unkept"] > 0
        before = record_until_full("stopped")
        told = sentence(client.post("/recordings/stopped/stop"), 503)
        assert (
            f"ended after {before['frames']} frames, because stopped.mcap.active could not be written" in told
        )
        listed = {each["id"]: each for each in client.get("/recordings").raise_for_status().json()}
        assert listed["stopped"]["state"] == "interrupted"
        assert listed["stopped"]["frames"] == before["frames"]
        ballast.unlink()
        recovered = client.post("/recordings/stopped/recover").raise_for_status().json()
        assert (recovered["state"], recovered["frames"]) == ("finished", before["frames"])


def test_a_read_only_disk_is_one_sentence(disk: Path) -> None:
    (port,) = ports.private_ports(1)
    remount = f'mount -o remount,ro {quote(str(disk))} && exec "$@"'
    done = run_to_its_end(on_small_disk("1m", disk, remount, "api", "--port", port, "--data", disk / "data"))
    assert done.returncode == 2
    assert "cannot be written (Read-only file system); name another folder" in done.stderr
