"""Coverage-guided fuzzing of the decoders: `python -m tests.fuzz TARGET... --minutes 5`, or `--executions 1000000`.

It needs atheris, which has wheels for Linux on x86-64 only. What fails is kept as a file in `kept/TARGET`, which the
tests replay; the corpus grows in a folder of its own.
`--distil` then packs the shortest inputs that reached new code into `corpus/TARGET.bin`.
"""

import argparse
import atexit
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from deltalight.protocol.files import write_bytes
from deltalight.protocol.vectors import frame_pieces
from tests.fuzz.seeds import CORPUS, KEPT, corpus, seeds
from tests.fuzz.targets import TARGETS

MEMORY_MB, ALLOCATION_MB, HANG_S = 3072, 2048, 300
LONGEST_INPUT = 32_768
DISTILLED_BYTES = 6_000  # of a target
MOST_CRASHES = 20
NO_ATHERIS = "fuzzing needs atheris, which there is for Linux on x86-64 and Python up to 3.13"


@dataclass(frozen=True)
class Plan:
    """How long each target is fuzzed: `minutes`, or `executions` however long they take; `seed` 0 is a new one.

    What fails is kept in the target's folder in `kept`.
    """

    seed: int
    minutes: float = 2.0
    executions: int | None = None
    kept: Path = KEPT


def main() -> None:
    """Fuzz the chosen targets one after the other and print their figures as JSON lines."""
    options = _options()
    if find_spec("atheris") is None:
        sys.exit(NO_ATHERIS)
    plan = Plan(options.seed, options.minutes, options.executions)
    for target in options.targets or TARGETS:
        print(json.dumps(fuzzed(target, options.work, plan)), flush=True)
        if options.distil:
            _distil(target, options.work / target)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument(
        "targets", nargs="*", choices=[*TARGETS, []], metavar="TARGET", help=", ".join(TARGETS)
    )
    parser.add_argument("--minutes", type=float, default=2.0, help="for each target")
    parser.add_argument("--executions", type=int, help="of each target, however long they take")
    parser.add_argument("--seed", type=int, default=0, help="of the mutations; 0: another one each time")
    parser.add_argument("--work", type=Path, default=Path("build/fuzz"), help="folder of the grown corpus")
    parser.add_argument("--distil", action="store_true", help="renew the corpus that the tests replay")
    return parser.parse_args()


def write_seeds(target: str, grown: Path) -> None:
    """Writes the first inputs and the corpus as files beside `grown`, which libFuzzer wants."""
    folder = _seed_folder(grown)
    folder.mkdir(parents=True, exist_ok=True)
    for number, content in enumerate([*(data for name, data in seeds() if name == target), *corpus(target)]):
        (folder / f"{number:04d}").write_bytes(content)
    (KEPT / target).mkdir(parents=True, exist_ok=True)


def fuzzed(target: str, work: Path, plan: Plan) -> dict[str, Any]:
    """Runs until the time is up or enough was executed, again after each crash; returns the figures.

    The corpus grows in the target's folder in `work`.
    """
    grown, kept = work / target, plan.kept / target
    for folder in (grown, kept):
        folder.mkdir(parents=True, exist_ok=True)
    write_seeds(target, grown)
    began_s, executions, crashes, peak_mb, slowest_ms = time.monotonic(), 0, 0, 0, 0
    before = _contents(kept)
    while (left := _left(plan, time.monotonic() - began_s, executions)) and crashes < MOST_CRASHES:
        seed = plan.seed and plan.seed + crashes
        code, told = run_fuzzer(target, grown, kept, left, f"-seed={seed}")
        executions += told_figure(told, "number_of_executed_units")
        peak_mb = max(peak_mb, told_figure(told, "peak_rss_mb"))
        slowest_ms = max(slowest_ms, told_figure(told, "slowest_input_ms"))
        if code == 0:
            break
        crashes += 1
        print(told[-3000:], file=sys.stderr, flush=True)
    return {
        "target": target,
        "seed": plan.seed,
        "seconds": round(time.monotonic() - began_s),
        "executions": executions,
        "crashes": crashes,
        "found": sorted(_contents(kept) - before),
        "peak_mb": peak_mb,
        "slowest_ms": slowest_ms,
        "inputs": len(list(grown.iterdir())),
    }


def _left(plan: Plan, passed_s: float, executions: int) -> str | None:
    """Returns libFuzzer's option for what is left to do; None if nothing is."""
    if plan.executions is None:
        left, option = round(60 * plan.minutes - passed_s), "-max_total_time"
    else:
        left, option = plan.executions - executions, "-runs"
    return f"{option}={left}" if left > 0 else None


def run_fuzzer(target: str, grown: Path, kept: Path, *options: str) -> tuple[int, str]:
    """Fuzz with libFuzzer's options until its process ends; return the exit code (minus a signal) and what it told.

    The corpus grows in `grown`, beside which the first inputs lie (`write_seeds`); what fails goes to `kept`.
    """
    folders = [str(each) for each in (grown, _seed_folder(grown), KEPT / target)]
    limits = [f"-rss_limit_mb={MEMORY_MB}", f"-malloc_limit_mb={ALLOCATION_MB}", f"-timeout={HANG_S}"]
    limits += [f"-max_len={LONGEST_INPUT}", f"-artifact_prefix={kept}/", "-print_final_stats=1"]
    parent = _parent()
    assert parent.stdin is not None
    assert parent.stdout is not None
    with NamedTemporaryFile() as told:
        parent.stdin.write(json.dumps([target, [*options, *limits, *folders], told.name]) + "\n")
        parent.stdin.flush()
        code = parent.stdout.readline()
        if not code:
            raise RuntimeError("The process that forks fuzzers has ended; its lines above say why.")
        return int(code), told.read().decode(errors="replace")


@cache
def _parent() -> subprocess.Popen[str]:
    """Starts the process that forks fuzzers, which ends with this one: its standard input does."""
    parent = subprocess.Popen(
        [sys.executable, "-m", "tests.fuzz.child"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    atexit.register(parent.communicate)
    return parent


def told_figure(told: str, name: str) -> int:
    """Returns one of libFuzzer's closing figures or what the child told last, 0 if it is missing."""
    found = re.findall(rf"stat::{name}:\s+(\d+)", told)
    return int(found[-1]) if found else 0


def _contents(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _seed_folder(grown: Path) -> Path:
    return grown.with_name(f"{grown.name}-seeds")


def _distil(target: str, grown: Path) -> None:
    """Pack the corpus anew: each input of the grown one reached new code; the shortest come first."""
    chosen, room = [], DISTILLED_BYTES
    for content in sorted(
        {path.read_bytes() for path in grown.iterdir()}, key=lambda each: (len(each), each)
    ):
        room -= len(content)
        if room < 0:
            break
        chosen.append(content)
    write_bytes(CORPUS / f"{target}.bin", frame_pieces(chosen))


if __name__ == "__main__":
    main()
