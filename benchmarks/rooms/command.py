"""`deltalight bench rooms` with parsed options: one placer after another, each act so many times; and the files."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from deltalight import __version__
from deltalight.benchmarks.rooms.acts import ACTS, ROOM, ActRecord, Run, measure
from deltalight.benchmarks.rooms.hosts import running_hosts
from deltalight.benchmarks.rooms.installation import NODE, ROOMS, started
from deltalight.benchmarks.rooms.report import RoomsReport, all_figures, markdown
from deltalight.benchmarks.soak.command import renderer_of
from deltalight.benchmarks.soak.crowd import Crowd
from deltalight.benchmarks.soak.link import LoopThread
from deltalight.benchmarks.soak.report import Machine, print_figures
from deltalight.benchmarks.soak.samples import require_proc
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes
from deltalight.services.files import make_output_folder

WATCHED = ROOMS[:2]
SLOTS = len(WATCHED) + 1  # one is free, to move into
KEPT_LINES = 3  # of the log, in sentences

Say = Callable[[str], None]


def run_rooms(placers: Sequence[str], times: int, out: Path, say: Say) -> RoomsReport:
    """Measures, and writes rooms.json and rooms.md into the folder `out`.

    Raises:
        DeltalightError: this is no Linux, Ray is missing, no picture came, or a room did not come back.
    """
    require_proc("bench rooms")
    make_output_folder(out)
    load_before, began_s = os.getloadavg()[0], time.monotonic()
    records: list[ActRecord] = []
    renderer = ""
    for placer in placers:
        say(f"{placer}: starting {len(WATCHED)} rooms in {SLOTS} slots")
        with _running(placer) as run:
            renderer = renderer_of(run.installation.client, f"/rooms/{ROOM}/nodes")
            for _ in range(times):
                records += [_said(measure(run, name, act), say) for name, act in ACTS[placer].items()]
    report = RoomsReport(
        version=__version__,
        machine=Machine(renderer=renderer, cpus=os.cpu_count() or 1, load_before=load_before),
        times=times,
        seconds=time.monotonic() - began_s,
        figures=all_figures({placer: ACTS[placer] for placer in placers}, records),
        acts=records,
    )
    write_bytes(out / "rooms.json", report.model_dump_json(indent=1).encode())
    write_bytes(out / "rooms.md", markdown(report).encode())
    return report


def print_report(report: RoomsReport, out: Path) -> None:
    """Prints the figures as a table, and where the files are."""
    print_figures("Rooms", report.figures, f"The report is in {out}: rooms.json, rooms.md")


@contextmanager
def _running(placer: str) -> Iterator[Run]:
    """Runs rooms by a placer, watched by a viewer; nothing is left afterwards."""
    with (
        TemporaryDirectory(prefix="deltalight-bench-") as folder,
        LoopThread("viewers") as thread,
    ):
        place, log = Path(folder), Path(folder) / "log"
        try:
            if placer == "local":
                with started(place, rooms=WATCHED, slots=SLOTS, log=log) as found:
                    yield Run(placer, found, Crowd(thread, found.page_port, [NODE], ROOM))
            else:
                with running_hosts(*[{}] * SLOTS) as hosts:
                    options = ("--placer", placer, "--ray-address", hosts.cluster.address)
                    with started(place, *options, rooms=WATCHED, log=log) as found:
                        found.hosts = hosts.raylets
                        yield Run(placer, found, Crowd(thread, found.page_port, [NODE], ROOM), hosts)
        except DeltalightError as fault:
            said = log.read_text().splitlines()[-KEPT_LINES:] if log.exists() else []
            raise DeltalightError(f"{fault} The last lines were: {' / '.join(said)}") from fault


def _said(record: ActRecord, say: Say) -> ActRecord:
    say(f"{record.placer}: {record.act}: {record.gap_s:.2f} s")
    return record
