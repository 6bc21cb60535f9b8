"""All figures of the fuzzing in one file: `python -m tests.fuzz.report --out FILE`; hours on two busy cores.

Mutated messages and files go to the decoders (`tests.fuzz`), messages over sockets (`tests.fuzz.over_sockets`) and
requests over HTTP (`tests.fuzz.over_http`) to running stations. The file is written anew after each part. The exit
code is 1 if there is any fault.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal

from deltalight import __version__
from deltalight.benchmarks.soak.command import renderer_of
from deltalight.benchmarks.soak.report import Machine
from deltalight.protocol.documents import StrictModel
from deltalight.protocol.files import write_bytes
from tests.fuzz.__main__ import NO_ATHERIS, Plan, fuzzed
from tests.fuzz.over_http import requested, say
from tests.fuzz.over_sockets import attacked, small_station
from tests.fuzz.seeds import KEPT

REPORT: Final = "python -m tests.fuzz.report"
FILES = ("gltf", "radiance", "mcap", "archive")
OWN = "fuzzer"  # the process that runs a decoder


class Sizes(StrictModel):
    """How much each part does."""

    envelopes: int = 1_000_000
    of_each_file: int = 10_000
    messages: int = 100_000
    openapi_minutes: float = 30.0


QUICK = Sizes(envelopes=2000, of_each_file=200, messages=1000, openapi_minutes=0.2)


class Part(StrictModel):
    """One part: `peak_mb` and `deaths` are by process, `slowest_ms` is that of one input, `details` differ."""

    name: str
    executions: int
    seconds: float
    faults: list[str]
    slowest_ms: float
    peak_mb: dict[str, float]
    deaths: dict[str, int]
    details: dict[str, Any]


class FuzzReport(StrictModel):
    """All parts that have ended."""

    report: Literal["python -m tests.fuzz.report"] = REPORT
    version: str
    machine: Machine
    seed: int
    sizes: Sizes
    parts: list[Part]

    @property
    def faults(self) -> list[str]:
        """All faults, with the names of their parts."""
        return [f"{part.name}: {fault}" for part in self.parts for fault in part.faults]


def main() -> None:
    """Fuzz everything, and write the report."""
    options = _options()
    if find_spec("atheris") is None:
        sys.exit(NO_ATHERIS)
    report = fuzz_all(_sizes(options), options.seed, options.out)
    for fault in report.faults:
        say(fault)
    sys.exit(bool(report.faults))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=REPORT, description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the JSON file to write")
    parser.add_argument("--seed", type=int, default=1, help="of everything")
    parser.add_argument("--openapi-minutes", type=float, help="for the requests (30)")
    parser.add_argument("--quick", action="store_true", help="a minute for all: only to see whether it works")
    return parser.parse_args()


def _sizes(options: argparse.Namespace) -> Sizes:
    sizes = QUICK if options.quick else Sizes()
    minutes = options.openapi_minutes
    return sizes if minutes is None else sizes.model_copy(update={"openapi_minutes": minutes})


@dataclass
class _Job:
    """What is to be done; the stations tell the renderer."""

    sizes: Sizes
    seed: int
    work: Path
    kept: Path
    renderer: str = ""


def fuzz_all(sizes: Sizes, seed: int, out: Path, kept: Path = KEPT) -> FuzzReport:
    """Runs all parts one after the other; `out` is written after each. Files that fail are kept in `kept`."""
    parts, load_before = list[Part](), os.getloadavg()[0]
    with TemporaryDirectory(prefix="deltalight-fuzz-") as work:
        job = _Job(sizes, seed, Path(work), kept)
        runs = list(_runs(job))
        for number, (name, run) in enumerate(runs, start=1):
            say(f"{number} of {len(runs)}: {name}")
            parts.append(run())
            say(f"  {parts[-1].executions} in {parts[-1].seconds:.0f} s, {len(parts[-1].faults)} faults")
            machine = Machine(renderer=job.renderer, cpus=os.cpu_count() or 1, load_before=load_before)
            report = FuzzReport(version=__version__, machine=machine, seed=seed, sizes=sizes, parts=parts)
            write_bytes(out, f"{report.model_dump_json(indent=1)}\n".encode())
    return report


def _runs(job: _Job) -> Iterator[tuple[str, Callable[[], Part]]]:
    targets = {"envelope": job.sizes.envelopes, **dict.fromkeys(FILES, job.sizes.of_each_file)}
    for target, executions in targets.items():
        yield (
            target,
            partial(_decoder, target, job.work, Plan(job.seed, executions=executions, kept=job.kept)),
        )
    yield "sockets", partial(_sockets, job)
    yield "openapi", partial(_openapi, job)


def _decoder(target: str, work: Path, plan: Plan) -> Part:
    found = fuzzed(target, work, plan)
    return Part(
        name=target,
        executions=found["executions"],
        seconds=found["seconds"],
        faults=found["found"],
        slowest_ms=found["slowest_ms"],
        peak_mb={OWN: found["peak_mb"]},
        deaths={OWN: found["crashes"]},
        details={"inputs_that_reached_new_code": found["inputs"]},
    )


def _sockets(job: _Job) -> Part:
    with small_station(job.seed) as station:
        job.renderer = renderer_of(station.client)
        found = attacked(station, job.sizes.messages, Random(job.seed))
    return _of_station(
        "sockets",
        found,
        executions=found["messages"],
        faults=_counted({"requests without an answer": found["unanswered"]}),
        slowest_ms=found["slowest_answer_ms"],
        details={key: found[key] for key in ("streams", "longest_gap_s")},
    )


def _openapi(job: _Job) -> Part:
    with small_station(job.seed) as station:
        found = requested(station, job.sizes.openapi_minutes, job.seed, say)
    wrong = [json.dumps(each) for each in (*found["failures"], *found["errors"])]
    return _of_station(
        "openapi",
        found,
        executions=found["requests"],
        faults=[*wrong, *_counted({"internal faults": found["internal_faults"]})],
        slowest_ms=found["slowest_ms"],
        details={key: found[key] for key in ("operations", "statuses", "slowest", "rate_limited")},
    )


def _of_station(
    name: str,
    found: dict[str, Any],
    *,
    executions: int,
    faults: list[str],
    slowest_ms: float,
    details: dict[str, Any],
) -> Part:
    memory_mb = found["memory_mb"]
    return Part(
        name=name,
        executions=executions,
        seconds=found["seconds"],
        faults=[*faults, *_counted({f"deaths of {each}": count for each, count in found["deaths"].items()})],
        slowest_ms=slowest_ms,
        peak_mb={each: peak for each, (_, peak) in memory_mb.items()},
        deaths=found["deaths"],
        details={**details, "memory_before_mb": {each: before for each, (before, _) in memory_mb.items()}},
    )


def _counted(counts: dict[str, int]) -> list[str]:
    return [f"{count} {what}" for what, count in counts.items() if count]


if __name__ == "__main__":
    main()
