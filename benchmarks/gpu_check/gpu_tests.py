"""The renderer's tests as a step of `deltalight gpu-check`, by pytest."""

import os
from importlib.util import find_spec
from pathlib import Path

import pytest

from deltalight.benchmarks.gpu_check.beside_tests import ROOT, TESTS
from deltalight.benchmarks.gpu_check.record import Findings

OTHER_STEPS = "test_protected_pictures.py"  # the pictures have a step of their own
MOST_WORKERS = 8


class Recorder:
    """Counts outcomes as they come, because time may run out."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self.counts = {"passed": 0, "failed": 0, "skipped": 0}
        self.left_out: list[str] = []

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Keep which test runs: a driver may end the process."""
        done = sum(self.counts.values())
        self._findings.keep(f"{done} tests done, {nodeid} was begun last", counts=self.counts)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test once; what goes wrong before or after it is a failure too."""
        if report.when == "call" or not report.passed:
            self.counts[report.outcome] += 1
        if report.failed:
            lines = [line for line in report.longreprtext.splitlines() if line.startswith("E ")]
            self._findings.fault(f"{report.nodeid}: {lines[0][1:] if lines else report.when}")

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Note a file that cannot be collected; for want of a package it is left out."""
        if not report.failed:
            return
        reason = f"{report.nodeid}: {report.longreprtext.splitlines()[-1].removeprefix('E ').strip()}"
        if "ModuleNotFoundError" in reason:
            self.left_out.append(reason)
            self._findings.keep(left_out=self.left_out)
        else:
            self._findings.fault(reason)


def run_tests(findings: Findings, marked: str, tests: Path = TESTS) -> str:
    """Run the tests below `tests` that the marker expression takes; pytest-xdist, if installed, spreads them."""
    recorder = Recorder(findings)
    options = [
        "-q",
        "-p",
        "no:cacheprovider",
        f"--rootdir={ROOT}",
        "-m",
        marked,
        "--continue-on-collection-errors",
    ]
    options += ["--basetemp", str(findings.scratch / "tests"), f"--ignore={tests / OTHER_STEPS}"]
    if find_spec("xdist") is not None:
        options += ["-n", str(min(os.cpu_count() or 1, MOST_WORKERS)), "--dist", "worksteal"]
    ended = pytest.main([*options, str(tests)], plugins=[recorder])
    if ended not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):  # the latter without faults: left out
        findings.fault(f"pytest ended with {ended!r}")
    counts = {**recorder.counts, "files left out for want of a package": len(recorder.left_out)}
    return ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
