"""The renderer's tests as a step of `deltalight gpu-check`, by pytest."""

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import pytest

from deltalight.benchmarks.gpu_check.beside_tests import ROOT, TESTS
from deltalight.benchmarks.gpu_check.processes import usable_cores
from deltalight.benchmarks.gpu_check.record import Findings

OTHER_STEPS = "test_protected_pictures.py"  # the pictures have a step of their own
MISSING_PACKAGE = re.compile(r"ModuleNotFoundError: No module named '(?!deltalight\b|tests\b)")
LEFT_OUT = "left out for want of a package"


class Recorder:
    """Counts outcomes as they come, because time may run out."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self.counts = {"passed": 0, "failed": 0, "skipped": 0, LEFT_OUT: 0}
        self.left_out: list[str] = []
        self._total = 0

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Notes how many tests there are; where workers run them, nothing is collected here."""
        self._total = max(self._total, len(session.items))

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: Sequence[str]) -> None:
        """Notes how many tests a worker found, which is all."""
        self._total = len(ids)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Keeps which test runs: a driver may end the process."""
        done = sum(self.counts.values())
        said = f"{done} of {self._total} tests done, {nodeid} was begun last"
        self._findings.keep(said, counts=self.counts)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Counts a test once; what goes wrong before or after it is a failure too, but for want of a package."""
        if report.passed and report.when != "call":
            return
        lines = [line for line in report.longreprtext.splitlines() if line.startswith("E ")]
        reason = f"{report.nodeid}: {lines[0][1:].strip() if lines else report.when}"
        if report.failed and MISSING_PACKAGE.search(reason):
            self._leave_out(reason)
            return
        self.counts[report.outcome] += 1
        if report.failed:
            self._findings.fault(reason)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Notes a file that cannot be collected; for want of a package it is left out."""
        if not report.failed:
            return
        reason = f"{report.nodeid}: {report.longreprtext.splitlines()[-1].removeprefix('E ').strip()}"
        if MISSING_PACKAGE.search(reason):
            self._leave_out(reason)
        else:
            self._findings.fault(reason)

    def _leave_out(self, reason: str) -> None:
        self.counts[LEFT_OUT] += 1
        self.left_out.append(reason)
        self._findings.keep(left_out=self.left_out)


def run_tests(findings: Findings, marked: str, tests: Path = TESTS) -> str:
    """Runs the tests below `tests` that the marker expression takes; pytest-xdist, if installed, spreads them."""
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
        options += ["-n", str(usable_cores()), "--dist", "worksteal"]
    ended = pytest.main([*options, str(tests)], plugins=[recorder])
    if ended not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):  # the latter without faults: left out
        findings.fault(f"pytest ended with {ended!r}")
    return ", ".join(f"{count} {outcome}" for outcome, count in recorder.counts.items())
