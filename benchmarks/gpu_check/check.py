"""Takes the steps one after the other, each in a process of its own, and writes the report after every change."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from deltalight.benchmarks.gpu_check.plan import MACHINE, Step
from deltalight.benchmarks.gpu_check.record import Record, State, read_record
from deltalight.benchmarks.gpu_check.report import Report, about_checkout
from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE

ROOT = Path(__file__).resolve().parents[2]
OUTPUT_FILE = "output.log"
POLL_S = 0.5
KILL_TIMEOUT_S = 5.0  # a process that hangs in a driver may outlive its end
TAIL_CHARACTERS = 300

Say = Callable[[str], None]


def check_gpu(out: Path, steps: Sequence[Step], missing: Sequence[str], say: Say) -> Report:
    """Takes the steps and returns the report, which is in the folder `out` too; `say` is told of progress.

    `missing`: the packages that are not installed.

    Raises:
        DeltalightError: the folder cannot be written.
    """
    report = Report(out, about_checkout(ROOT), list(missing))
    (out / OUTPUT_FILE).write_bytes(b"")
    started_s, budget_s = time.monotonic(), 0.0
    with TemporaryDirectory(prefix="deltalight-gpu-check-") as folder:
        for step in (MACHINE, *steps):
            budget_s += step.budget_s
            limit_s = budget_s - (time.monotonic() - started_s)
            say(f"{step.name}: up to {limit_s:.0f} s")
            record = _take(step, limit_s, report, Path(folder))
            report.put(step.name, record)
            say(f"{step.name}: {record.state} after {record.seconds:.0f} s ({record.sentence})")
    report.finish()
    return report


def _take(step: Step, limit_s: float, report: Report, folder: Path) -> Record:
    """Runs the step's process for at most `limit_s` and returns what it found."""
    path, output = folder / f"{step.name}.json", report.out / OUTPUT_FILE
    report.put(step.name, Record())
    started_s = time.monotonic()
    with _child(step, path, report.out, folder) as child:
        while (code := _ended(child)) is None and time.monotonic() - started_s < limit_s:
            report.put(step.name, read_record(path))
    record = replace(read_record(path), seconds=round(time.monotonic() - started_s, 1))
    if code is None:
        said = record.sentence or "nothing was found yet"
        return replace(record, state=State.OUT_OF_TIME, sentence=f"ended after {limit_s:.0f} s; {said}")
    if code != 0 or record.state is State.RUNNING:
        said = f"{record.sentence}; {_exit(code)}".removeprefix("; ")
        faults = [*record.faults, f"{_exit(code)}; its output ended: {_tail(output)}"]
        return replace(record, state=State.FAILED, sentence=said, faults=faults)
    return record


@contextmanager
def _child(step: Step, path: Path, out: Path, folder: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """The step's process; it and whatever it started end with the context."""
    command = [
        sys.executable,
        "-m",
        "deltalight.benchmarks.gpu_check.child",
        step.target,
        str(path),
        str(out.resolve()),
    ]
    mine = {**_caches(folder), SUPERVISOR_VARIABLE: str(os.getpid())}
    with (out / OUTPUT_FILE).open("ab") as output:
        output.write(f"== {step.name}\n".encode())
        output.flush()
        child = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **mine},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        yield child
    finally:
        with suppress(ProcessLookupError):  # it ended by itself, and left nothing running
            os.killpg(child.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            child.wait(KILL_TIMEOUT_S)


def _caches(folder: Path) -> dict[str, str]:
    """Variables by which steps share what they compute, and what NVIDIA's driver compiles: it keeps none for root."""
    shaders = folder / "shaders"
    shaders.mkdir(exist_ok=True)
    driver = {
        "__GL_SHADER_DISK_CACHE": "1",
        "__GL_SHADER_DISK_CACHE_PATH": str(shaders),
        "__GL_SHADER_DISK_CACHE_SKIP_CLEANUP": "1",
    }
    return {"DELTALIGHT_CACHE": str(folder / "cache"), **driver}


def _ended(child: "subprocess.Popen[bytes]") -> int | None:
    """Waits a moment for the process; returns its exit code, None while it runs."""
    with suppress(subprocess.TimeoutExpired):
        return child.wait(POLL_S)
    return None


def _exit(code: int) -> str:
    if code >= 0:
        return f"the step's process ended with {code}"
    return f"the step's process was ended by {signal.Signals(-code).name}"


def _tail(output: Path) -> str:
    """The end of what processes wrote, on one line."""
    return " ".join(output.read_text(errors="replace")[-TAIL_CHARACTERS:].split())
