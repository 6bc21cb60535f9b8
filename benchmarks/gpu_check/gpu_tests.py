"""The renderer's tests as a step of `deltalight gpu-check`, by pytest."""

import os
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.gpu_check.beside_tests import ROOT, TESTS
from benchmarks.gpu_check.record import Findings

OTHER_STEPS = "test_protected_pictures.py"  # the pictures have a step of their own
MOST_WORKERS = 8


class Recorder:
    """Counts outcomes as they come; in time that may run out, the tests that one waits for are first."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self.counts = {"passed": 0, "failed": 0, "skipped": 0}
        self.total = 0

    @pytest.hookimpl(wrapper=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> Generator[None]:
        """Put slow tests last."""
        yield
        items.sort(key=lambda item: item.get_closest_marker("slow") is not None)
        self.total = len(items)

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
        """Note a file that cannot be collected."""
        if report.failed:
            self._findings.fault(f"{report.nodeid}: {report.longreprtext.splitlines()[-1]}")


def run_tests(findings: Findings, tests: Path = TESTS) -> str:
    """Run the tests below `tests`, spread over the cores where pytest-xdist is installed."""
    recorder = Recorder(findings)
    options = [
        "--all",
        "-q",
        "-p",
        "no:cacheprovider",
        f"--rootdir={ROOT}",
        f"--basetemp={findings.scratch / 'tests'}",
    ]
    if find_spec("xdist") is not None:
        options += ["-n", str(min(os.cpu_count() or 1, MOST_WORKERS)), "--dist", "worksteal"]
    ended = pytest.main([*options, f"--ignore={tests / OTHER_STEPS}", str(tests)], plugins=[recorder])
    if ended not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        findings.fault(f"pytest ended with {ended!r}")
    return ", ".join(f"{count} {outcome}" for outcome, count in recorder.counts.items())
