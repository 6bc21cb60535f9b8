"""The processes that libFuzzer runs in: forks of one, which instruments the decoders as it imports them.

That takes 2.7 s of processor time, which each process would spend again.
"""

import hashlib
import json
import os
import sys
import time
import traceback
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["deltalight"]):
    from tests.fuzz.targets import attempt

SLOW_S = 1.0  # of processor time


def main() -> None:
    """Reads jobs from stdin and prints the exit code of each one's process, a line each, until stdin ends.

    A job is JSON: a target, libFuzzer's options and folders, and the file that takes what the process tells.
    """
    for line in sys.stdin:
        target, options, told = json.loads(line)
        child = os.fork()
        if child == 0:
            _redirect(told)
            fuzz(target, options)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def _redirect(told: str) -> None:
    """Leaves the parent's pipes to the parent."""
    with Path(os.devnull).open("r+") as nothing, Path(told).open("w") as file:
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)
        os.dup2(file.fileno(), 2)


def fuzz(target: str, options: list[str]) -> None:
    """Fuzz until libFuzzer ends the process; faults that Python can catch are kept, once each by their place."""
    seen, slowest_s = set[str](), 0.0
    kept = Path(next(word for word in options if word.startswith("-artifact_prefix=")).partition("=")[2])

    def test_one(data: bytes) -> None:
        nonlocal slowest_s
        began_s = time.process_time()
        try:
            attempt(target, data)
        except Exception as fault:
            _keep(kept, _place(fault), data, fault, seen)
        took_s = time.process_time() - began_s
        if took_s > slowest_s:
            slowest_s = took_s
            print(
                f"stat::slowest_input_ms: {1e3 * took_s:.0f}", file=sys.stderr, flush=True
            )  # as libFuzzer does
        if took_s > SLOW_S:
            _keep(kept, "slow", data, None, seen)

    atheris.Setup([sys.argv[0], *options], test_one)
    atheris.Fuzz()


def _place(fault: Exception) -> str:
    frames = [frame for frame in traceback.extract_tb(fault.__traceback__) if "/tests/" not in frame.filename]
    last = frames[-1] if frames else None
    return (
        f"{type(fault).__name__}-{Path(last.filename).stem}-{last.lineno}" if last else type(fault).__name__
    )


def _keep(folder: Path, place: str, data: bytes, fault: Exception | None, seen: set[str]) -> None:
    if place in seen:
        return
    seen.add(place)
    (folder / f"{place}-{hashlib.sha256(data).hexdigest()[:8]}").write_bytes(data)
    if fault is not None:
        print("".join(traceback.format_exception(fault)), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
