"""A disk of the kernel's own that is full or read-only, or a limit of files, under `api` and `record`.

What is refused is one sentence, and nothing is half-written.

The disk is a tmpfs of a mount namespace, so it needs a Linux that lets the user make one.
"""

import secrets
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote

import httpx
import psutil
import pytest

from deltalight.protocol.source import open_source
from deltalight.services import ports
from tests.services.api_samples import sentence
from tests.services.conftest import ROOT, RunCli
from tests.services.record_samples import feeding
from tests.services.storage_samples import TETRAHEDRON
from tests.services.test_api_process import wait_for

OWN_MOUNTS = ("unshare", "--user", "--map-root-user", "--mount")
MOUNT = 'mount -t tmpfs -o "size=$0" tmpfs "$1"'
PATIENCE_S = 60
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
def serving(disk: Path, size: str, script: str) -> Iterator[tuple[httpx.Client, int]]:
    """A web process that a shell script starts, with its data on a disk of this size; and its process id."""
    (port,) = ports.private_ports(1)
    command = on_small_disk(size, disk, script, "api", "--port", port, "--data", disk / "data")
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
    kept = []
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


def run_to_its_end(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_a_recording_that_fills_the_disk_keeps_its_frames(disk: Path, tmp_path: Path, cli: RunCli) -> None:
    kept = tmp_path / "kept"
    keep = f'"$@"; code=$?; cp -r {quote(str(disk))} {quote(str(kept))}; exit $code'
    with feeding() as (endpoint, _):
        done = run_to_its_end(
            on_small_disk("1m", disk, keep, "record", "--out", disk / "a.mcap", "--subscribe", endpoint)
        )
    assert done.returncode == 2, done.stderr
    assert "No space left on device" in done.stderr.strip().splitlines()[-1]
    assert "Traceback" not in done.stderr
    (active,) = kept.iterdir()
    assert cli("recordings", "recover", active).returncode == 0
    assert len(open_source(kept / "a.mcap")) > 0


def test_a_read_only_disk_is_one_sentence(disk: Path) -> None:
    (port,) = ports.private_ports(1)
    remount = f'mount -o remount,ro {quote(str(disk))} && exec "$@"'
    done = run_to_its_end(on_small_disk("1m", disk, remount, "api", "--port", port, "--data", disk / "data"))
    assert done.returncode == 2
    assert "cannot be written (Read-only file system); name another folder" in done.stderr
