"""`deltalight record`: Ctrl-C, kill -9, nobody there; each with real processes or sockets."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from deltalight.protocol.calibration import Extrinsics, save_extrinsics_yaml
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.pictures import depth_from_steps
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.request import ReplyServer
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.source import open_source
from deltalight.services import ports, recorder
from deltalight.services.cli import app
from deltalight.services.recorder import RecordJob
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.follower import following
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.rooms.status import RoomNode
from tests.services.conftest import ROOT, RunCli
from tests.services.record_samples import (
    BOARD,
    HEIGHT,
    PATIENCE_S,
    WIDTH,
    Published,
    camera,
    composite,
    feeding,
    frames,
    messages,
    recording,
    wait_for,
    write,
)
from tests.services.room_samples import StandInPlacer, plans, running

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `deltalight` processes, and ends those that are left."""
    started: list[subprocess.Popen[str]] = []

    def run(*arguments: object, limit_bytes: int | None = None) -> "subprocess.Popen[str]":
        words = [str(argument) for argument in arguments]
        limit = f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, {limit_bytes}))"
        program = "from deltalight.services.cli import main\nmain()"
        code = f"import resource, sys\n{limit if limit_bytes else ''}\n{program}"
        process = subprocess.Popen(
            [sys.executable, "-c", code, *words],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("takes") / "take.mcap", frames(8))


@pytest.fixture
def published(take: Path, start: Start) -> str:
    """Endpoint of a node process that replays thirty frames a second in a loop."""
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    start("node", "--source", take, "--loop", "--publish", endpoint)
    return endpoint


@pytest.mark.slow
def test_a_killed_recorder_loses_at_most_the_last_second(
    published: str, start: Start, cli: RunCli, tmp_path: Path
) -> None:
    out, active = tmp_path / "a.mcap", tmp_path / "a.mcap.active"
    watched = Published(published)
    try:
        wait_for(lambda: watched.captured_ns)
        process = start("record", "--out", out, "--subscribe", published)
        wait_for(lambda: active.exists() and active.stat().st_size > 300_000)
        process.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        process.wait()
        wait_for(lambda: max(watched.captured_ns.values()) > killed_ns)
    finally:
        watched.close()
    assert not out.exists()
    done = cli("recordings", "recover", active, "--json")
    assert done.returncode == 0, done.stderr
    found = open_source(out)
    recovered = [frame.frame_id for frame in found]
    assert json.loads(done.stdout)["frames"] == len(recovered)
    wanted = {
        number
        for number, captured_ns in watched.captured_ns.items()
        if number >= recovered[0] and captured_ns <= killed_ns - 1_000_000_000
    }
    assert wanted <= set(recovered)
    assert len(recovered) >= 10
    assert all(watched.captured_ns[frame.frame_id] == frame.timestamp_ns for frame in found)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_a_signal_finishes_the_recording(
    published: str, start: Start, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    out = tmp_path / "takes" / "a.mcap"
    process = start("record", "--out", out, "--subscribe", published, "--json")
    active = out.with_name("a.mcap.active")
    wait_for(lambda: active.exists() and active.stat().st_size > 100_000)
    process.send_signal(number)
    output, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, error
    assert [path.name for path in out.parent.iterdir()] == ["a.mcap"]
    summary = json.loads(output)
    source = open_source(out)
    assert summary["frames"] == len(source) > 2
    assert summary["bytes"] == out.stat().st_size
    assert source.board == BOARD
    assert not any("not finished" in note for note in source.notes)
    known = frames(8)
    for frame in source:
        original = known[frame.frame_id % 8]
        assert frame.color_jpeg == original.color_jpeg
        assert frame.depth is not None
        assert original.depth is not None
        assert np.array_equal(frame.depth.depth_m, original.depth.depth_m)


@pytest.mark.slow
def test_ctrl_c_while_the_disk_refuses_leaves_what_was_recorded(
    published: str, start: Start, cli: RunCli, tmp_path: Path
) -> None:
    out, active = tmp_path / "a.mcap", tmp_path / "a.mcap.active"
    process = start("record", "--out", out, "--subscribe", published, limit_bytes=200_000)
    assert process.stderr is not None
    refused = process.stderr.readline()
    source = open_source(active)
    assert f"a.mcap.active cannot grow (File too large); its {len(source)} frames are kept" in refused
    process.send_signal(signal.SIGINT)
    output, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    (sentence,) = error.strip().splitlines()
    assert "File too large" in sentence
    assert "recordings recover" in sentence
    assert not output
    assert f"after {len(source)} frames" in sentence
    assert len(source) > 5
    assert cli("recordings", "recover", active).returncode == 0
    assert [frame.frame_id for frame in open_source(out)] == [frame.frame_id for frame in source]


@pytest.mark.slow
def test_ctrl_c_before_any_frame_leaves_no_file(start: Start, tmp_path: Path) -> None:
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    process = start("record", "--out", tmp_path / "a.mcap", "--subscribe", endpoint)
    assert process.stderr is not None
    first = process.stderr.readline()
    assert f"No frame came from {endpoint} for 3 s" in first
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "Nothing was recorded" in error
    assert not list(tmp_path.iterdir())


def test_frames_and_duration_end_a_recording(tmp_path: Path) -> None:
    with feeding() as (endpoint, _):
        with recording(RecordJob(tmp_path / "a.mcap", (endpoint,), frames=5)) as (_, notices, end):
            status = end.result(PATIENCE_S)
        with recording(RecordJob(tmp_path / "b.mcap", (endpoint,), duration_s=0.5)) as (_, _, end):
            longer = end.result(PATIENCE_S)
    assert (status.frames, status.as_dict()["frames"], notices) == (5, 5, [])
    assert status.missing == {"color": 0, "depth": 0, "pose": 0}
    assert len(open_source(tmp_path / "a.mcap")) == 5
    assert longer.seconds >= 0.5
    assert longer.frames == len(open_source(tmp_path / "b.mcap")) >= 1


def test_relit_pictures_are_kept_with_their_frames(
    cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A renderer that is a frame behind: each picture comes after the next frame."""
    monkeypatch.setattr(recorder, "SILENCE_S", PATIENCE_S)  # a busy machine is silent for seconds
    node, server = Publisher("tcp://127.0.0.1:*"), Publisher("tcp://127.0.0.1:*")
    job = RecordJob(tmp_path / "a.mcap", (node.endpoint,), frames=4, composites=server.endpoint)
    with recording(job) as (running, notices, end):
        before = None
        for frame in frames(200):
            for multipart in messages(frame).values():
                node.send(multipart)
            time.sleep(0.02)
            if before is not None:
                server.send(composite(before))
            before = frame
            if end.done():
                break
    node.close()
    server.close()
    status = end.result()
    source = open_source(tmp_path / "a.mcap")
    assert (status.frames, notices) == (4, [])
    pictures = [(frame.composite, frame.color_jpeg) for frame in source if frame.composite is not None]
    assert status.composites == len(pictures) >= 3  # the server's subscription may come after the first
    assert all(relit == camera for relit, camera in pictures)
    assert source[3].composite is not None  # it was waited for
    shown = cli("recordings", "info", tmp_path / "a.mcap").stdout
    assert f"relit pictures │ {status.composites}" in " ".join(shown.split())
    assert running.status.as_dict()["composites"] == status.composites


def test_relit_pictures_of_a_room_go_on_when_another_render_server_takes_it_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "SILENCE_S", PATIENCE_S)
    node, placer = Publisher("tcp://127.0.0.1:*"), StandInPlacer()
    keeper = RoomKeeper(plans(tmp_path, "hall", "door"), placer)
    directory = ports.endpoint(ports.private_ports(1)[0])
    running(keeper, placer, "hall", "door")
    server = Publisher(placer.of("hall").publish)
    shown: list[int] = []
    with (
        closing(DirectoryServer(directory, keeper)),
        recording(RecordJob(tmp_path / "a.mcap", (node.endpoint,))) as (made, _, end),
        following(directory, "hall", None, made.follow),
    ):
        for frame in frames(400):
            if frame.frame_id == 150:
                server.close()
                placer.lose("hall")
                running(keeper, placer, "hall")
                server = Publisher(placer.of("hall").publish)
            for multipart in messages(frame).values():
                node.send(multipart)
            server.send(composite(frame))
            time.sleep(0.01)
            if made.status.composites > len(shown):
                shown.append(frame.frame_id)
            if shown and shown[-1] > 200:
                break
    node.close()
    server.close()
    assert end.result().frames > 150
    kept = [number for number, frame in enumerate(open_source(tmp_path / "a.mcap")) if frame.composite]
    assert min(shown) < 150 < max(shown)
    assert len(kept) == made.status.composites


def test_a_room_to_record_is_one_of_a_directory_that_answers(cli: RunCli, tmp_path: Path) -> None:
    directory, out = ports.endpoint(ports.private_ports(1)[0]), tmp_path / "a.mcap"
    nobody = ("--subscribe", ports.endpoint(ports.private_ports(1)[0]))

    def refused(*options: str) -> str:
        answer = cli("record", "--out", out, *nobody, *options)
        assert answer.returncode == 2
        return answer.stderr

    assert "belong together" in refused("--room", "hall")
    assert "does not answer" in refused("--rooms", directory, "--room", "hall")
    with closing(DirectoryServer(directory, RoomKeeper(plans(tmp_path, "hall"), StandInPlacer()))):
        assert "did you mean hall?" in refused("--rooms", directory, "--room", "hal")
    assert not out.exists()


def test_a_room_is_recorded_without_its_nodes_address(cli: RunCli, tmp_path: Path) -> None:
    directory, out = ports.endpoint(ports.private_ports(1)[0]), tmp_path / "a.mcap"
    (plan,) = plans(tmp_path, "hall")
    with feeding() as (endpoint, _):
        fed = replace(plan, nodes=(RoomNode(name="cam", endpoint=endpoint), *plan.nodes))
        options = ("record", "--out", out, "--rooms", directory, "--room", "hall", "--frames", "2")
        with closing(DirectoryServer(directory, RoomKeeper([fed], StandInPlacer()))):
            refused = cli(*options, "--name", "third")
            assert refused.returncode == 2
            assert "the room hall has no node third; choose one of cam, desk." in refused.stderr
            done = cli(*options)
    assert done.returncode == 0, done.stderr
    assert len(open_source(out)) == 2


def test_a_node_that_goes_and_comes_back_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "SILENCE_S", 0.6)
    with (
        feeding() as (endpoint, feed),
        recording(RecordJob(tmp_path / "a.mcap", (endpoint,))) as (running, notices, end),
    ):
        wait_for(lambda: running.status.frames >= 3)
        feed.paused.set()
        wait_for(lambda: notices)
        before = running.status.frames
        feed.paused.clear()
        wait_for(lambda: running.status.frames > before)
    assert [notice.split(" from ")[0] for notice in notices] == ["No frame came", "Frames come again."]
    assert "the frames so far are kept" in notices[0]
    assert len(open_source(tmp_path / "a.mcap")) == end.result().frames > before


def test_another_node_than_the_wanted_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "SILENCE_S", 0.6)
    with (
        feeding() as (endpoint, _),
        recording(RecordJob(tmp_path / "a.mcap", (endpoint,), node="desk")) as (_, notices, end),
    ):
        wait_for(lambda: notices)
    assert "No frame of node desk" in notices[0]
    assert "only of cam" in notices[0]
    assert end.result().frames == 0
    assert not list(tmp_path.iterdir())


def test_broken_and_late_messages_are_counted(tmp_path: Path) -> None:
    publisher = Publisher("tcp://127.0.0.1:*")
    numbered = frames(40)
    with recording(RecordJob(tmp_path / "a.mcap", (publisher.endpoint,))) as (running, notices, end):
        sent = 0
        while running.status.frames < 2:  # until the subscription has arrived
            for multipart in messages(numbered[sent]).values():
                publisher.send(multipart)
            sent += 1
            time.sleep(0.05)
        broken, late = messages(numbered[sent]), messages(replace(numbered[1], frame_id=sent + 1))
        broken["color"][1] = b"no header"
        whole = messages(numbered[sent + 2])
        for multipart in (*broken.values(), *late.values(), *whole.values(), *late.values()):
            publisher.send(multipart)
        wait_for(lambda: running.status.dropped["late"] == 2)  # and so what was sent before has been taken
    publisher.close()
    status = end.result()
    assert status.dropped == {"broken": 1, "late": 2}
    assert notices[0].startswith("Skipping a message: ")
    assert numbered[sent + 2].timestamp_ns in open_source(tmp_path / "a.mcap").timestamps_ns


def test_the_scene_comes_from_a_file_or_from_the_render_server(cli: RunCli, tmp_path: Path) -> None:
    scene = parse_scene({"name": "kept"})
    (tmp_path / "scene.json").write_text(scene.model_dump_json())

    def answer(request: ControlRequest) -> dict[str, object]:
        assert request.op == "get_scene"
        return {"scene": scene.model_dump(mode="json")}

    server = ReplyServer("tcp://127.0.0.1:*", answer)
    try:
        with feeding() as (endpoint, _):
            for name, options in {
                "a.mcap": ("--scene", tmp_path / "scene.json"),
                "b.mcap": ("--control", server.endpoint),
            }.items():
                common = ("--out", tmp_path / name, "--subscribe", endpoint, "--frames", 1)
                done = cli("record", *common, *options)
                assert done.returncode == 0, done.stderr
                assert open_source(tmp_path / name).scene == scene
    finally:
        server.close()


def test_depth_of_another_camera_wants_the_transform(tmp_path: Path) -> None:
    small = camera(WIDTH // 2, HEIGHT // 2)
    depth = depth_from_steps(np.full((HEIGHT // 2, WIDTH // 2), 900, np.uint16), 0.001, small, None)
    shift = np.eye(4)
    shift[0, 3] = 0.05
    save_extrinsics_yaml(tmp_path / "extrinsics.yaml", Extrinsics(depth_from_rgb=shift))
    publisher = Publisher("tcp://127.0.0.1:*")
    for name, extrinsics in {"a.mcap": None, "b.mcap": Extrinsics(depth_from_rgb=shift)}.items():
        job = RecordJob(tmp_path / name, (publisher.endpoint,), extrinsics=extrinsics, frames=1)
        with recording(job) as (_, notices, end):
            for frame in frames(200):
                for multipart in messages(replace(frame, depth=depth)).values():
                    publisher.send(multipart)
                time.sleep(0.02)
                if end.done():
                    break
        assert end.result().frames == 1
        assert [("--extrinsics" in notice) for notice in notices] == ([True] if extrinsics is None else [])
    publisher.close()
    recorded = open_source(tmp_path / "b.mcap").extrinsics.depth_from_rgb
    assert np.array_equal(np.asarray(recorded), shift)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--out", "{folder}/taken.mcap"], "taken.mcap already exists"),
        (["--out", "{folder}/growing.mcap"], "growing.mcap.active already exists"),
        (["--out", "{folder}/a.bag"], "must end in .mcap"),
        (["--out", "{folder}/taken.mcap/a.mcap"], "is a file"),
        (["--out", "{folder}/a.mcap", "--subscribe", "tcp://127.0.0.1"], "is not an endpoint"),
        (["--out", "{folder}/a.mcap", "--subscribe", "udp://127.0.0.1:1"], "is not an endpoint"),
        (["--out", "{folder}/a.mcap", "--scene", "a.json", "--control", "tcp://127.0.0.1:1"], "give one"),
        (["--out", "{folder}/a.mcap", "--subscribe", "tcp://127.0.0.1:1", "--node", "desk"], "give one"),
        (["--out", "{folder}/a.mcap", "--scene", "{folder}/none.json"], "none.json"),
        (["--out", "{folder}/a.mcap", "--extrinsics", "{folder}/none.yaml"], "none.yaml"),
    ],
)
def test_wrong_options_are_sentences(tmp_path: Path, options: list[str], words: str) -> None:
    (tmp_path / "taken.mcap").touch()
    (tmp_path / "growing.mcap.active").touch()
    done = CliRunner().invoke(app, ["record", *(option.format(folder=tmp_path) for option in options)])
    assert isinstance(done.exception, DeltalightError)
    assert words in str(done.exception)
    assert "\n" not in str(done.exception)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["growing.mcap.active", "taken.mcap"]
