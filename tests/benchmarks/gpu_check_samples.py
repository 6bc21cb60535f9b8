"""Steps of `gpu-check` that go wrong, and one that does not; each runs in a process of its own."""

import os
import time

from deltalight.benchmarks.gpu_check.record import Findings, Skipped
from deltalight.protocol.errors import DeltalightError


def fine(findings: Findings) -> str:
    findings.keep(answer=42)
    return "found"


def crash(findings: Findings) -> str:
    findings.keep("half of it was done", done=1)
    print("the driver's last words", flush=True)
    os.abort()


def hang(findings: Findings) -> str:
    findings.keep("begun", pid=os.getpid())
    time.sleep(600)
    return "never"


def wrong(findings: Findings) -> str:
    findings.fault("the sky is\n green")
    return "looked"


def left_out(findings: Findings) -> str:
    raise Skipped(f"nothing for it in {findings.out.name}")


def broken(findings: Findings) -> str:
    raise ValueError(f"no {findings.path.suffix}")


def packageless(findings: Findings) -> str:
    import no_such_package  # type: ignore[import-not-found]

    return str(no_such_package) + str(findings)


def at_work(number: int) -> int:
    if number > 0:
        os.abort()
    return number


def at_fault(what: str) -> int:
    raise DeltalightError(f"{what} is green")
