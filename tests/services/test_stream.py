"""The way out to a media server: real receivers in processes of their own.

FFmpeg listens by RTSP and RTMP, `srt-live-transmit` (Debian's srt-tools) by SRT.
"""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.services import h264, ports, srt, stream_out
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.srt import SrtAddress
from deltalight.services.stream_out import StreamOut, Target
from tests.services.conftest import ROOT, RunCli
from tests.services.moving_samples import HEIGHT, WIDTH, MovingStream, picture, psnr_db
from tests.services.room_samples import StandInPlacer, plans, running

LEAST_PSNR_DB = 35.0
PATIENCE_S = 60.0
BY_SRT = pytest.mark.skipif(not shutil.which("srt-live-transmit"), reason="srt-tools is not installed")
PHASES = 40
# Decodes what comes, and keeps each picture in a folder.
RECEIVER = """
import subprocess
import sys
from pathlib import Path
import av
import numpy as np
from deltalight.services.h264 import rgb_picture
url, folder, options = sys.argv[1], Path(sys.argv[2]), dict(each.split("=") for each in sys.argv[3:])
if url.startswith("srt:"):
    command = ["srt-live-transmit", "-q", url + "&mode=listener", "file://con"]
    url = subprocess.Popen(command, stdout=subprocess.PIPE).stdout
with av.open(url, options=options) as container:
    for number, frame in enumerate(container.decode(video=0)):
        np.save(folder / "part.npy", rgb_picture(frame))
        (folder / "part.npy").rename(folder / f"{number:06d}.npy")
"""
LISTENING = {
    "rtsp": {"rtsp_flags": "listen", "listen_timeout": "60"},
    "rtmp": {"listen": "1", "analyzeduration": "100000"},
    "srt": {"analyzeduration": "100000"},
}


class Receiver:
    """A process that listens at an address until it is killed."""

    def __init__(self, url: str, folder: Path) -> None:
        folder.mkdir()
        options = [f"{key}={value}" for key, value in LISTENING[url.partition(":")[0]].items()]
        command = [sys.executable, "-c", RECEIVER, url, str(folder), *options]
        self._process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True)
        self._folder = folder

    @property
    def pictures(self) -> list[np.ndarray]:
        return [np.load(path) for path in sorted(self._folder.glob("0*.npy"))]

    def close(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)  # what it started too
        self._process.wait()


@contextmanager
def receiving(url: str, folder: Path) -> Iterator[Receiver]:
    receiver = Receiver(url, folder)
    try:
        yield receiver
    finally:
        receiver.close()


@contextmanager
def sending(*options: str) -> Iterator["subprocess.Popen[str]"]:
    """`deltalight stream` as a process, killed at the end."""
    command = [sys.executable, "-m", "deltalight.services.cli", "stream", *options]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.1)


def show_until(out: StreamOut, is_enough: Callable[[], object]) -> None:
    """Shows pictures that move, ten a second, until there is enough."""
    deadline_s, phase = time.monotonic() + PATIENCE_S, 0
    while not is_enough():
        assert time.monotonic() < deadline_s
        out.show(picture(WIDTH, HEIGHT, phase % PHASES))
        phase += 1
        time.sleep(0.1)


def agreements_db(pictures: list[np.ndarray]) -> list[float]:
    """PSNR of each from the shown picture that agrees most."""
    shown = [picture(WIDTH, HEIGHT, phase) for phase in range(PHASES)]
    return [max(psnr_db(seen, each) for each in shown) for seen in pictures]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "path"),
    [
        ("rtsp", "/live/room"),
        ("rtmp", "/live/room"),
        pytest.param("srt", "?passphrase=0123456789ab", marks=BY_SRT),
    ],
)
def test_pictures_arrive_and_resume_when_the_receiver_comes_back(
    scheme: str, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_out, "FIRST_WAIT_S", 0.3)
    monkeypatch.setattr(stream_out, "LONGEST_WAIT_S", 0.6)
    (port,) = ports.private_ports(1)
    url, told = f"{scheme}://{ports.LOOPBACK}:{port}{path}", list[str]()
    with StreamOut(Target.parse(url), told.append) as out:
        for part in ("before", "after"):
            with receiving(url, tmp_path / part) as receiver:
                show_until(out, lambda receiver=receiver: len(receiver.pictures) > 5)  # type: ignore[misc]
                assert min(agreements_db(receiver.pictures)) > LEAST_PSNR_DB
            show_until(out, lambda: not out.status.is_connected)
    place = f"{scheme}://{ports.LOOPBACK}:{port}"
    takes = f"{place} is receiving the relit picture, 160x120; press Ctrl-C to stop."
    assert [each for each in told if "takes no" not in each] == [takes, takes]
    assert all(
        each.startswith(place) and each.endswith("trying again until it does.")
        for each in told
        if each != takes
    )
    assert len(told) == len([each for n, each in enumerate(told) if n == 0 or each != told[n - 1]])


@pytest.mark.slow
def test_ctrl_c_ends_the_command_and_no_line_holds_a_secret(tmp_path: Path) -> None:
    port, published = ports.private_ports(2)
    url = f"rtsp://{ports.LOOPBACK}:{port}/stream-key"
    stream = MovingStream(published)
    secret = url.replace("//", "//me:secret@")
    options = ("--composites", ports.endpoint(published), "--to", secret)
    with receiving(url, tmp_path / "got") as receiver, sending(*options) as process:
        wait_for(lambda: len(receiver.pictures) >= 3)
        process.send_signal(signal.SIGINT)
        _, printed = process.communicate(timeout=PATIENCE_S)
    stream.close()
    assert process.returncode == 130, printed
    assert "is receiving the relit picture, 160x120" in printed
    assert "secret" not in printed
    assert "stream-key" not in printed
    assert "Traceback" not in printed


@pytest.mark.slow
def test_pictures_of_a_room_go_on_when_another_render_server_takes_it_over(tmp_path: Path) -> None:
    (port,) = ports.private_ports(1)
    url, directory = f"rtsp://{ports.LOOPBACK}:{port}/room", ports.endpoint(ports.private_ports(1)[0])
    placer = StandInPlacer()
    keeper = RoomKeeper(plans(tmp_path, "hall", "door"), placer)
    running(keeper, placer, "hall", "door")
    options = ("--rooms", directory, "--room", "hall", "--to", url)
    with (
        closing(DirectoryServer(directory, keeper)),
        receiving(url, tmp_path / "got") as receiver,
        closing(MovingStream(_port(placer, "door"))),
        sending(*options),
    ):
        with closing(MovingStream(_port(placer, "hall"))) as first:
            wait_for(lambda: len(receiver.pictures) > 3)
            first.is_still = True
            wait_for(lambda: psnr_db(*receiver.pictures[-2:]) > LEAST_PSNR_DB)
        still = receiver.pictures[-1]
        placer.lose("hall")
        running(keeper, placer, "hall")
        with closing(MovingStream(_port(placer, "hall"))):
            wait_for(lambda: psnr_db(receiver.pictures[-1], still) < LEAST_PSNR_DB)
            count = len(receiver.pictures)
            wait_for(lambda: len(receiver.pictures) > count + 5)


def _port(placer: StandInPlacer, room: str) -> int:
    return int(placer.of(room).publish.rpartition(":")[2])


def test_pictures_are_of_a_room_or_of_an_endpoint(cli: RunCli) -> None:
    def refused(*options: str) -> str:
        done = cli("stream", "--to", "rtsp://media.example/a", *options)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr
        return done.stderr

    nobody = ports.endpoint(ports.private_ports(1)[0])
    assert "belong together" in refused("--room", "hall")
    assert "give one of them" in refused("--composites", nobody, "--rooms", nobody, "--room", "hall")
    assert "does not answer" in refused("--rooms", nobody, "--room", "hall")


@pytest.mark.slow
def test_a_server_that_refuses_or_never_answers_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_out, "FIRST_WAIT_S", 0.0)
    monkeypatch.setattr(stream_out, "CLOSE_TIMEOUT_S", 0.0)
    (port,) = ports.private_ports(1)
    told = list[str]()
    target = Target.parse(f"rtsp://{ports.LOOPBACK}:{port}/a")
    with StreamOut(target, told.append) as out:
        for _ in range(2):
            out.show(picture(WIDTH, HEIGHT, 0))
        assert told == [f"{target.shown} takes no pictures (Connection refused); trying again until it does."]
        assert out.status.pictures == 0
        with socket.create_server((ports.LOOPBACK, port)):
            monkeypatch.setattr(stream_out, "ANSWER_TIMEOUT_S", 3.0)
            out.show(picture(WIDTH, HEIGHT, 0))
        assert "(no answer for 3 s)" in told[-1]


def test_wrong_addresses_are_one_sentence(cli: RunCli) -> None:
    for url in (
        "",
        "media.example",
        "http://media.example/a",
        "rtsp://",
        "rtsp://h:x/a",
        "rtsp://h/a b",
        "rtsp://[/",
    ):
        done = cli("stream", "--to", url)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr
        assert "rtsp://HOST:8554/NAME" in done.stderr
    target = Target.parse("rtmp://me:secret@[::1]:1935/live/key?token=x")
    assert target.shown == "rtmp://[::1]:1935"


@pytest.mark.parametrize(
    ("query", "what"),
    [
        ("", "a host and a port"),
        (":8890?mode=listener", "takes streamid, passphrase, pbkeylen, latency, each once, not 'mode'"),
        (f":8890?{'k' * 5000}=1", f"each once, not '{'k' * 40}'"),
        (":8890?latency=1&latency=2", "each once"),
        (f":8890?latency={'9' * 5000}", "latency of an SRT address is 0 to 30000"),
        (":8890?latency=soon", "latency of an SRT address is 0 to 30000"),
        (":8890?passphrase=short", "passphrase of an SRT address has 10 to 79 bytes"),
        (":8890?pbkeylen=17", "16, 24 or 32"),
        (":8890?streamid=", "streamid of an SRT address has 1 to 512 bytes"),
    ],
)
def test_wrong_addresses_of_srt_are_one_sentence(query: str, what: str) -> None:
    with pytest.raises(DeltalightError, match=re.escape(what)):
        Target.parse(f"srt://media.example{query}")


def test_access_control_of_srt_is_passed_on_as_it_is() -> None:
    address = SrtAddress.parse("srt://media.example:8890?streamid=#!::m=publish,r=room&latency=200")
    assert address.options == ((srt.STREAM_ID, "#!::m=publish,r=room"), (srt.PEER_LATENCY, 200))


@BY_SRT
def test_a_wrong_passphrase_is_told(tmp_path: Path) -> None:
    (port,) = ports.private_ports(1)
    url, told = f"srt://{ports.LOOPBACK}:{port}?passphrase=", list[str]()
    with (
        receiving(f"{url}0123456789ab", tmp_path / "got"),
        StreamOut(Target.parse(f"{url}ba9876543210"), told.append) as out,
    ):
        show_until(out, lambda: any("Incorrect passphrase" in each for each in told))
    assert "9876543210" not in "".join(told)


def test_without_libsrt_a_sentence_says_so(cli: RunCli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(srt, "LIBRARIES", ())
    done = cli("stream", "--to", "srt://media.example:8890?streamid=publish:room")
    assert (done.returncode, done.stderr.strip()) == (2, f"deltalight: {srt.NO_LIBRARY}")


def test_without_pyav_a_sentence_says_so(cli: RunCli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(h264, "why_unavailable", lambda: h264.NO_AV)
    done = cli("stream", "--to", "rtsp://media.example/a")
    assert (done.returncode, done.stderr.strip()) == (2, f"deltalight: {h264.NO_AV}")
