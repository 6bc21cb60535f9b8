"""`deltalight bench soak`: its links, figures and plots by themselves, and a short soak of real processes."""

import json
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import cast
from xml.etree import ElementTree

import pytest

from deltalight.benchmarks.soak import peers, spares
from deltalight.benchmarks.soak.command import SoakJob, run_soak
from deltalight.benchmarks.soak.crowd import Flow, Seen
from deltalight.benchmarks.soak.faults import FAULTS, parse_faults
from deltalight.benchmarks.soak.figures import Soaked, all_figures
from deltalight.benchmarks.soak.link import SHAPES, Link, LoopThread, Schedule, Shape, held_up_s
from deltalight.benchmarks.soak.nonsense import known_messages, mutated
from deltalight.benchmarks.soak.plots import known_runs, nice_ceiling
from deltalight.benchmarks.soak.profiles import PROFILES
from deltalight.benchmarks.soak.report import Bar, FaultRecord, SoakReport, worst
from deltalight.benchmarks.soak.samples import ProcessSample, Sample, parse_drops
from deltalight.benchmarks.soak.station import Station, source_of
from deltalight.protocol.envelope import decode, encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.sensor_node.node import NodeConfig
from deltalight.services import ports
from deltalight.services.cli import run
from deltalight.services.demo import RECORDING, SCENE
from deltalight.services.settings import load_configuration

KILLS = 20  # of each process
SLOW_LINK = Shape(bits_per_s=8e6, delay_s=0.05, jitter_s=0.0, loss=0.0)


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([2071.4, 18034.2], "2071 to 18034 ms"),
        ([0.02571, 18.83], "0.0257 to 18.8 ms"),
        ([61.6, 61.61], "61.6 ms"),
    ],
)
def test_a_range_is_shown_to_three_digits_but_never_by_powers_of_ten(values: list[float], shown: str) -> None:
    figure = worst("age", "while nothing fails", values, Bar("shown", lambda _value: True), "ms")
    assert figure is not None
    assert figure.result == shown


def test_a_link_delays_by_its_band_and_its_way() -> None:
    schedule = Schedule(random.Random(1))
    assert schedule.leaves_s(10.0, 1000, None) == 10.0
    assert schedule.leaves_s(10.0, 1000, SLOW_LINK) == pytest.approx(10.051)
    assert schedule.leaves_s(10.0, 2000, SLOW_LINK) == pytest.approx(10.053)  # behind the first
    assert schedule.leaves_s(20.0, 1000, SLOW_LINK) == pytest.approx(20.051)


def test_what_is_lost_holds_up_all_behind_it_until_it_is_there() -> None:
    assert [held_up_s(losses, SLOW_LINK) for losses in range(4)] == pytest.approx([0, 0.1, 0.3, 0.7])
    lossy = Schedule(random.Random(1))
    left_s = [lossy.leaves_s(10.0, 1000, replace(SLOW_LINK, loss=0.3)) - 10.05 for _ in range(200)]
    held_s = [after - before - 0.001 for before, after in pairwise(left_s)]
    assert left_s == sorted(left_s)
    assert sum(held > 0.09 for held in held_s) / 199 == pytest.approx(0.3, abs=0.1)
    assert sum(held > 0.29 for held in held_s) / 199 == pytest.approx(0.09, abs=0.06)


def test_what_is_overtaken_holds_up_for_its_longer_way_and_no_band_is_lost() -> None:
    schedule = Schedule(random.Random(1))
    assert schedule.leaves_s(10.0, 1000, replace(SLOW_LINK, overtaken=1.0)) == pytest.approx(10.101)
    assert schedule.leaves_s(10.0, 1000, SLOW_LINK) == pytest.approx(10.101), "waits for the one before"
    assert schedule.leaves_s(11.0, 1000, SLOW_LINK) == pytest.approx(11.051)


def test_over_a_narrow_link_a_queue_ages_more_than_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "message_bytes", lambda _size: 60_000)
    load = replace(
        PROFILES["small"], frames_per_s=50.0, load_s=2.5
    )  # three times as much as the link carries
    with LoopThread("peers") as thread:
        flows = peers.peers_on(thread, SLOW_LINK, load, seed=1)
    newest, queued = (flows[name].age_p95_ms for name in ("newest", "queued"))
    assert newest is not None
    assert queued is not None
    assert 100 < newest < queued


def test_after_a_cut_a_queue_delivers_what_is_old_and_the_newest_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        peers, "message_bytes", lambda _size: 60_000
    )  # what is cut fits into no socket's buffer
    load = replace(PROFILES["small"], frames_per_s=20.0, load_s=1.0)
    with LoopThread("peers") as thread:
        flows = peers.peers_on(thread, None, load, seed=1, cut_s=2.0)
    newest, queued = flows["newest"], flows["queued"]
    assert min(newest.longest_gap_s, queued.longest_gap_s) >= 1.9
    assert queued.frames_per_s > newest.frames_per_s > 0
    assert queued.age_p50_ms is not None
    assert newest.age_p50_ms is not None
    assert queued.age_p50_ms > newest.age_p50_ms


def test_the_rows_of_a_cut_stand_beside_those_of_a_queue() -> None:
    flow = {"age_p50_ms": 40.0, "age_p95_ms": 90.0, "longest_gap_s": 5.2}
    cut = FaultRecord(
        name="cut",
        began_s=1,
        ended_s=30,
        outcome={"back_s": 0.3, "during": flow, "newest": flow, "queued": {**flow, "age_p95_ms": 4600.0}},
    )
    figures = {(each.what, each.how): each for each in all_figures(soaked(faults=[cut]))}
    assert figures["picture back after a cut", "5 s, all links (1)"].is_met
    what = "5 s cut and the time after it"
    assert figures["longest gap", f"{what} (1)"].result == "5.2 s"
    assert figures["age, 95 of 100", f"{what}, no rendering (1)"].result == "90 ms"
    assert figures["age, 95 of 100", f"{what}, everything queued (1)"].result == "4600 ms"


def test_jitter_keeps_the_order() -> None:
    schedule, shape = Schedule(random.Random(1)), SHAPES["arm"]
    left_s = [schedule.leaves_s(0.001 * number, 100, shape) for number in range(500)]
    assert left_s == sorted(left_s)
    delays_s = [left - 0.001 * number for number, left in enumerate(left_s)]
    assert min(delays_s) >= shape.delay_s - shape.jitter_s


@pytest.fixture
def link() -> Iterator[tuple[Link, socket.socket, socket.socket]]:
    """A link, and the two ends of a connection through it."""
    with LoopThread("links") as thread, socket.create_server((ports.LOOPBACK, 0)) as node:
        (port,) = ports.private_ports(1)
        between = Link(port, node.getsockname()[1], seed=1)
        thread.start(between.serve())
        while not ports.answers(port):
            time.sleep(0.01)
        node.settimeout(10)
        node.accept()[0].close()  # of the question whether it answers
        with socket.create_connection((ports.LOOPBACK, port), timeout=10) as server:
            accepted, _ = node.accept()
            accepted.settimeout(10)
            with accepted:
                yield between, accepted, server


def received(end: socket.socket, size: int) -> bytes:
    found = b""
    while len(found) < size:
        piece = end.recv(size - len(found))
        assert piece
        found += piece
    return found


def test_a_link_carries_both_ways_whatever_its_shape(
    link: tuple[Link, socket.socket, socket.socket],
) -> None:
    between, node, server = link
    data = random.Random(1).randbytes(200_000)
    for shape in (None, SHAPES["arm"]):
        between.shape = shape
        node.sendall(data)
        assert received(server, len(data)) == data
        server.sendall(b"subscribe")
        assert received(node, 9) == b"subscribe"


def test_a_cut_link_carries_nothing_until_it_is_mended(
    link: tuple[Link, socket.socket, socket.socket],
) -> None:
    between, node, server = link
    between.cut(True)
    time.sleep(0.1)  # it takes effect in another thread
    node.sendall(b"late")
    server.settimeout(0.3)
    with pytest.raises(TimeoutError):
        server.recv(1)
    between.cut(False)
    server.settimeout(10)
    assert received(server, 4) == b"late"


def test_nonsense_is_refused_or_read_and_nothing_else() -> None:
    dice, known, refused = random.Random(3), known_messages(), 0
    for pieces in known:
        assert decode(pieces)[0].node == "stranger"
    for _ in range(1000):
        try:
            message, parts = decode(mutated(dice, dice.choice(known)))
        except DeltalightError:
            refused += 1
            continue
        assert decode(encode(message, parts))[0] == message
    assert 500 < refused < 1000


def test_drops_are_summed_over_processes_by_cause() -> None:
    text = """# TYPE deltalight_process_drops counter
deltalight_process_drops_total{cause="color.a",process="render-server"} 3.0
deltalight_process_drops_total{cause="bad_messages",process="render-server"} 2.0
deltalight_process_drops_total{cause="bad_messages",process="b"} 1.0
deltalight_process_rate{process="b",rate="fps"} 15.0"""
    assert parse_drops(text.splitlines()) == {"color.a": 3, "bad_messages": 3}


def test_flow_is_of_the_span_with_its_ends() -> None:
    seen = [Seen(at_s, 0, age_ms, 10.0) for at_s, age_ms in ((1.0, 30.0), (1.5, 50.0))]
    flow = Flow.of(seen, 0.0, 4.0)
    assert (flow.frames_per_s, flow.age_p50_ms, flow.longest_gap_s) == (0.5, 40.0, 2.5)
    assert flow.unwaited_p95_ms == pytest.approx(39.0)
    assert Flow.of([], 0.0, 4.0).age_p50_ms is None


def test_flow_of_several_cameras_waits_as_long_as_the_one_that_waits_longest() -> None:
    seen = [Seen(at_s, 0, 30.0, 0.0, "left") for at_s in (0.5, 1.5, 2.5, 3.5)] + [
        Seen(1.0, 0, 30.0, 0.0, "right")
    ]
    flow = Flow.of(seen, 0.0, 4.0, ["left", "right", "gone"])
    assert flow.frames_per_s == 1.25
    assert flow.camera_frames_per_s == {"left": 1.0, "right": 0.25, "gone": 0.0}
    assert flow.longest_gap_s == 4.0
    assert Flow.of(seen, 0.0, 4.0, ["left", "right"]).longest_gap_s == 3.0


def soaked(**changed: object) -> Soaked:
    """Two minutes of a station in which nothing happens; the process `leaky` opens a handle a second."""
    samples = [
        Sample(
            float(second),
            {
                "render server": ProcessSample(1, 10**8, 30),
                "leaky": ProcessSample(2, 10**8 + 10**5 * second, second),
            },
            0,
            0,
            200,
        )
        for second in range(120)
    ]
    seen = [Seen(second / 15, 0, 60.0, 20.0) for second in range(15 * 120)]
    record = Soaked(PROFILES["station"], samples, [(0.0, 120.0)], seen, [], {"leaky": 0}, 0, ["", "dark"])
    return replace(record, **changed)  # type: ignore[arg-type]


def test_figures_meet_their_bars_or_not() -> None:
    kill = FaultRecord(
        name="kill-server",
        began_s=1,
        ended_s=9,
        outcome={"back_s": 3.5, "same_document": True, "difference": 0.5},
    )
    figures = {each.what: each for each in all_figures(soaked(faults=[kill]))}
    met = {name: each.is_met for name, each in figures.items()}
    assert met == {
        "crashes": True,
        "orphans": True,
        "growth of memory (RSS)": False,
        "growth of open handles": False,
        "growth of GL objects": True,
        "age of a picture without waiting": True,
        "pictures a second of a camera": True,
        "picture back, render server": False,
        "scene equal by document": True,
        "scene equal by pixels": True,
    }
    assert figures["picture back, render server"].result == "3.5 s"
    assert figures["growth of open handles"].result == "0 to 59"
    assert figures["age of a picture without waiting"].result == "40 ms"
    assert figures["pictures a second of a camera"].result == "0 to 15"


def test_a_load_is_compared_with_calm_spans_beside_which_their_own_difference_is_shown() -> None:
    outcome = {
        when: {"frames_per_s": rate, "unwaited_p95_ms": 40.0}
        for when, rate in (("before", 50.0), ("during", 57.0), ("after", 54.0))
    }
    load = FaultRecord(name="nonsense", began_s=1, ended_s=9, outcome=outcome)
    figures = {each.what: each for each in all_figures(soaked(faults=[load]))}
    change, by_itself = figures["change of others' rate"], figures["change of the rate by itself"]
    assert (change.result, change.is_met) == ("9.62 %", False)
    assert (by_itself.result, by_itself.is_met) == ("7.69 %", True)


def test_what_a_spare_costs_others_is_shown_and_what_was_not_waited_for_is_not() -> None:
    flow = {"frames_per_s": 52.0, "unwaited_p95_ms": 140.0}
    outcomes: list[dict[str, object]] = [
        {"spare_ready_s": 31.0, "meanwhile": flow},
        {"spare_ready_s": None, "meanwhile": flow},
        {},
    ]
    kills = [FaultRecord(name="kill-server", began_s=1, ended_s=9, outcome=each) for each in outcomes]
    figures = {each.what: each for each in all_figures(soaked(faults=kills))}
    assert figures["spare ready"].result == "31 s"
    assert figures["pictures a second of all cameras"].how.endswith("(2)")
    assert figures["age without waiting, 95 of 100"].result == "140 ms"


class OneSpare:
    """Stands for a station whose spare is a process that works for a while, and then waits."""

    def __init__(self, process_id: int | None) -> None:
        self.process_id = process_id

    def spare_id(self, _name: str) -> int | None:
        return self.process_id

    def check(self) -> None:
        pass


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="there is no /proc")
def test_a_spare_is_ready_once_it_works_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spares, "QUIET_S", 1.0)
    monkeypatch.setattr(spares, "POLL_S", 0.05)
    work = "import time\nwhile time.process_time() < 1: pass\ntime.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", work]) as process:
        try:
            ready_s = spares.wait_for_spare(cast(Station, OneSpare(process.pid)), "server", 30.0)
        finally:
            process.kill()
    assert ready_s is not None
    assert 0.8 < ready_s < 30
    for known in (None, process.pid):  # none yet, or dead
        assert spares.wait_for_spare(cast(Station, OneSpare(known)), "server", 0.3) is None


def test_a_synthetic_node_has_the_size_and_rate_of_its_profile(tmp_path: Path) -> None:
    source, configuration = source_of(PROFILES["synthetic"], tmp_path)
    camera = load_configuration(configuration).section("node", NodeConfig).camera
    assert (source, camera.width, camera.height, camera.fps) == ("synthetic", 320, 240, 10)
    source, configuration = source_of(PROFILES["small"], tmp_path)
    assert RecordingReader(Path(source)).camera.width == 320
    assert not load_configuration(configuration).sections["node"]


def test_only_calm_samples_and_late_ones_count() -> None:
    quiet = {each.what: each for each in all_figures(soaked(calm=[(0.0, 61.0)], deaths={"leaky": 1}))}
    assert quiet["growth of open handles"].is_met
    assert not quiet["crashes"].is_met


@pytest.mark.parametrize(("from_s", "result", "is_met"), [(50, "0", True), (90, "40", False)])
def test_gl_objects_may_grow_during_a_start_only(from_s: int, result: str, is_met: bool) -> None:
    samples = [
        replace(each, gl_objects=240 if each.at_s >= from_s else 200)
        for each in soaked().samples
        if each.at_s % 3 == 0
    ]
    figures = {each.what: each for each in all_figures(soaked(samples=samples))}
    assert (figures["growth of GL objects"].result, figures["growth of GL objects"].is_met) == (
        result,
        is_met,
    )


def test_lines_end_where_nothing_is_known() -> None:
    assert known_runs([None, 1.0, 2.0, None, 3.0]) == [[1, 2], [4]]
    assert known_runs([1.0, None, 2.0, None, 3.0, None, None, 4.0]) == [[0, 2, 4], [7]]
    assert known_runs([None]) == []
    assert [nice_ceiling(value) for value in (0.0, 0.3, 1.0, 1.1, 30.0, 51.0)] == [1, 0.5, 1, 2, 50, 100]


@pytest.mark.parametrize(
    ("option", "words"),
    [(("--faults", "kill-servr"), "kill-server"), (("--profile", "staton"), "station")],
)
def test_wrong_options_are_sentences(
    option: tuple[str, str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["bench", "soak", *option]) == 2
    assert f"did you mean {words}?" in capsys.readouterr().err
    assert parse_faults("all") == list(FAULTS)
    assert parse_faults("none") == []


@pytest.mark.slow(seconds=170)
@pytest.mark.skipif(
    not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
)
def test_a_short_soak_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here depends on how fast the machine is. Each process is killed as soon as all is well again.

    A budget would: levels that a slow machine takes make GL objects of their own.
    """
    kills = ["kill-node", "kill-server", "kill-web"]
    names = [*kills * KILLS, "kill-recorder", "nonsense"]
    small = PROFILES["small"]
    output = {**small.output, "frame_budget_ms": None}
    monkeypatch.setitem(PROFILES, "small", replace(small, calm_s=0.2, output=output))
    said: list[str] = []
    report = run_soak(SoakJob("small", names, 0.0, 3), tmp_path, said.append)
    assert sorted(each.name for each in report.faults) == sorted(names)
    assert set(report.deaths.values()) == {0}, said
    assert report.orphans == 0
    of = {each.name: each.outcome for each in report.faults}
    killed = [each for each in report.faults if each.name in kills]
    assert len(killed) == 3 * KILLS
    assert all(each.outcome["same_document"] for each in killed)
    figures = {each.what: each.is_met for each in report.figures}
    assert figures["scene equal by pixels"]
    objects = [each for each in report.courses["GL objects"]["render server"] if each is not None]
    # Of all servers that were started. On a loaded machine one may have six objects more than the others (372).
    assert max(objects) <= 1.02 * median(objects)
    assert of["nonsense"]["sent"] > 100
    assert of["kill-recorder"]["frames"] > 0
    written = SoakReport.model_validate(json.loads((tmp_path / "soak.json").read_text()))
    assert written == report
    assert len(report.courses) == 6
    lengths = {len(values) for lines in report.courses.values() for values in lines.values()}
    assert lengths == {len(report.times_s)}
    assert "picture back, web process" in (tmp_path / "soak.md").read_text()
    ElementTree.parse(tmp_path / "soak.svg")
