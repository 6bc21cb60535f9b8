"""`deltalight bench soak` with parsed options: the course of a soak, and its files."""

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import httpx

from deltalight import __version__
from deltalight.benchmarks.soak.crowd import Crowd
from deltalight.benchmarks.soak.faults import FAULTS, Run
from deltalight.benchmarks.soak.figures import Soaked, all_courses, all_figures
from deltalight.benchmarks.soak.link import LoopThread
from deltalight.benchmarks.soak.plots import draw_soak
from deltalight.benchmarks.soak.profiles import choose_profile
from deltalight.benchmarks.soak.report import FaultRecord, Machine, SoakReport, markdown, print_figures
from deltalight.benchmarks.soak.samples import Sampler, require_proc
from deltalight.benchmarks.soak.spares import wait_for_spare
from deltalight.benchmarks.soak.station import SERVER, Station, running_station
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes
from deltalight.services import ports
from deltalight.services.files import make_output_folder

START_TIMEOUT_S = 300.0  # a cold shader cache on a slow machine takes a while, and each camera needs a frame
END_TIMEOUT_S = 5.0  # a process whose supervisor is gone ends itself
PLOT = "soak.svg"

Say = Callable[[str], None]


@dataclass(frozen=True)
class SoakJob:
    """What is soaked for how long; each of `faults` (names of FAULTS) is run at least once, ordered by the seed."""

    profile: str
    faults: Sequence[str]
    seconds: float
    seed: int


@dataclass
class _Log:
    """What a soak collects; times are of the monotonic clock, spans without a fault are `calm`."""

    began_s: float
    calm: list[tuple[float, float]] = field(default_factory=list)
    faults: list[FaultRecord] = field(default_factory=list)


def run_soak(job: SoakJob, out: Path, say: Say) -> SoakReport:
    """Soaks, and writes soak.json, soak.md and soak.svg into the folder `out`.

    Raises:
        DeltalightError: this is no Linux, no picture came, or it did not come back after a fault.
    """
    require_proc("bench soak")
    make_output_folder(out)
    report = soak(job, say)
    write_bytes(out / "soak.json", report.model_dump_json().encode())
    write_bytes(out / "soak.md", markdown(report, PLOT).encode())
    write_bytes(out / PLOT, draw_soak(report).encode())
    return report


def soak(job: SoakJob, say: Say) -> SoakReport:
    """Runs a station under faults and reports.

    Raises:
        DeltalightError: as `run_soak`.
    """
    profile, load_before = choose_profile(job.profile), os.getloadavg()[0]
    with ExitStack() as stack:
        thread = stack.enter_context(LoopThread("links and viewers"))
        station = stack.enter_context(running_station(profile, thread, job.seed))
        say("starting the station")
        _wait_for_page(station)
        run = Run(
            station, Crowd(thread, station.places.page, station.cameras), profile, Random(job.seed), thread
        )
        _wait_for_picture(run)
        wait_for_spare(station, SERVER, profile.spare_s)
        log = _Log(time.monotonic())
        with Sampler(station) as sampler:
            _put_to_faults(job, run, log, say)
        renderer, deaths = renderer_of(station.client), station.deaths()
        names, cameras = station.names, station.cameras
        seconds = time.monotonic() - log.began_s
        seen = run.crowd.between(log.began_s, float("inf"))
    soaked = Soaked(
        profile, sampler.samples, log.calm, seen, log.faults, deaths, _orphans(station.ids), cameras
    )
    say(f"ended; {len(log.faults)} faults")
    return SoakReport(
        version=__version__,
        machine=Machine(renderer=renderer, cpus=os.cpu_count() or 1, load_before=load_before),
        profile=job.profile,
        seed=job.seed,
        seconds=seconds,
        pictures=len(seen),
        deaths=deaths,
        orphans=soaked.orphans,
        figures=all_figures(soaked),
        faults=log.faults,
        times_s=[round(each.at_s - log.began_s, 1) for each in sampler.samples],
        courses=all_courses(sampler.samples, seen, names, cameras),
    )


def _put_to_faults(job: SoakJob, run: Run, log: _Log, say: Say) -> None:
    """Runs rounds of all faults, each round in an order of its own, until time is up; the first round is whole."""
    ends_s, number = log.began_s + job.seconds, 0
    _rest(run, log)
    while True:
        for name in run.dice.sample(list(job.faults), len(job.faults)):
            if number >= len(job.faults) and time.monotonic() > ends_s:
                return
            number += 1
            began_s = time.monotonic()
            say(f"{began_s - log.began_s:4.0f} s: {name}")
            outcome = FAULTS[name].run(run)
            ended_s = time.monotonic()
            log.faults.append(
                FaultRecord(
                    name=name, began_s=began_s - log.began_s, ended_s=ended_s - log.began_s, outcome=outcome
                )
            )
            _rest(run, log)
        if time.monotonic() > ends_s:
            return
        if not job.faults:
            _rest(run, log)


def _rest(run: Run, log: _Log) -> None:
    """Leaves the station alone for a while."""
    began_s = time.monotonic()
    time.sleep(run.profile.calm_s)
    run.station.check()
    log.calm.append((began_s, time.monotonic()))


def _wait_for_page(station: Station) -> None:
    _wait(station, lambda: ports.answers(station.places.page), "The web process does not answer")


def _wait_for_picture(run: Run) -> None:
    def all_came() -> bool:
        return len(run.crowd.pictures()) == len(run.crowd.cameras)

    _wait(run.station, all_came, "No picture of some camera came from the render server")


def _wait(station: Station, condition: Callable[[], bool], otherwise: str) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while not condition():
        station.check()
        if time.monotonic() > deadline_s:
            last = station.lines[-1] if station.lines else "nothing was logged"
            raise DeltalightError(f"{otherwise}; the last line was: {last}")
        time.sleep(0.1)


def renderer_of(client: httpx.Client, nodes: str = "/nodes") -> str:
    """Returns what the render server that reports to a web process renders with."""
    known = client.get(nodes).raise_for_status().json()
    detail = next((each["detail"] for each in known if each["kind"] == "render_server"), "")
    return str(detail).partition("; ")[0]  # remarks about faults and cameras follow


def _orphans(ids: set[int]) -> int:
    """Returns how many processes are still there; each has a moment to end."""
    deadline_s = time.monotonic() + END_TIMEOUT_S
    while (
        left := [each for each in ids if Path(f"/proc/{each}").exists()]
    ) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return len(left)


def print_report(report: SoakReport, out: Path) -> None:
    """Prints the figures as a table, and where the files are."""
    print_figures("Soak", report.figures, f"The report is in {out}: soak.json, soak.md, {PLOT}")
