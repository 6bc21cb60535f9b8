"""The report of `deltalight gpu-check`: report.json for programs, report.md to read."""

import json
import platform
import subprocess
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from deltalight.benchmarks.gpu_check.plan import MACHINE
from deltalight.benchmarks.gpu_check.record import Record, State
from deltalight.protocol.files import write_bytes

JSON_FILE = "report.json"
MARKDOWN_FILE = "report.md"
MOST_FAULTS = 20  # of a step in report.md; report.json has all


def about_checkout(root: Path) -> dict[str, str | None]:
    """Returns date, Python and commit; the commit is None where git or the repository is missing."""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        described = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
        commit = described.stdout.strip() or None
    except (OSError, subprocess.TimeoutExpired):
        commit = None
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"date": date, "python": platform.python_version(), "commit": commit}


@dataclass
class Report:
    """What is known so far. Every `put` writes the files of the folder `out` anew, if something changed."""

    out: Path
    about: dict[str, str | None]
    missing: list[str]
    records: dict[str, Record] = field(default_factory=dict)
    is_finished: bool = False

    def put(self, name: str, record: Record) -> None:
        """Sets a step's record."""
        if self.records.get(name) != record:
            self.records[name] = record
            self._write()

    def finish(self) -> None:
        """Says in the files that no step is to come."""
        self.is_finished = True
        self._write()

    @property
    def machine(self) -> dict[str, Any]:
        """GPU, driver and OpenGL version; empty where no context could be made."""
        return self.records[MACHINE.name].figures if MACHINE.name in self.records else {}

    @property
    def bad_steps(self) -> list[str]:
        """What failed or ran out of time, one phrase each."""
        return [f"{name} {_verb(record.state)}" for name, record in self.records.items() if record.is_bad]

    @property
    def sentence(self) -> str:
        """The outcome in one sentence."""
        gpu = self.machine.get("gpu", "a machine without OpenGL")
        software = ", a software renderer: no GPU was checked" if self.machine.get("is_software") else ""
        outcome = f"{', '.join(self.bad_steps)} on {gpu}" if self.bad_steps else f"no step failed on {gpu}"
        return f"{outcome}{software}; the report is {self.out / MARKDOWN_FILE}."

    def _write(self) -> None:
        steps = {name: record.as_dict() for name, record in self.records.items()}
        whole = {**self.about, **self.machine, "missing_packages": self.missing}
        whole |= {"finished": self.is_finished, "steps": steps}
        write_bytes(self.out / JSON_FILE, json.dumps(whole, indent=1).encode())
        write_bytes(self.out / MARKDOWN_FILE, self._markdown().encode())

    def _markdown(self) -> str:
        parts = [f"# GPU check\n\n{self._facts()}", self._steps(), *self._faults(), *self._timings()]
        if not self.is_finished:
            parts.insert(1, "**Not finished**: the steps below are those that were begun.")
        return "\n\n".join(parts) + "\n"

    def _facts(self) -> str:
        facts = {**self.about, **self.machine}
        lines = [f"* {name.replace('_', ' ')}: {value}" for name, value in facts.items()]
        return "\n".join([*lines, f"* packages that are not installed: {', '.join(self.missing) or 'none'}"])

    def _steps(self) -> str:
        rows = [
            f"| {name} | {record.state} | {record.seconds:.0f} | {record.sentence} |"
            for name, record in self.records.items()
        ]
        return "\n".join(["| step | outcome | seconds | |", "|---|---|--:|---|", *rows])

    def _faults(self) -> list[str]:
        parts = []
        for name, record in self.records.items():
            lines = [f"* {fault}" for fault in record.faults[:MOST_FAULTS]]
            if len(record.faults) > MOST_FAULTS:
                lines.append(f"* and {len(record.faults) - MOST_FAULTS} more, see {JSON_FILE}")
            if lines:
                parts.append(f"## {name}: what was wrong\n\n" + "\n".join(lines))
        return parts

    def _timings(self) -> list[str]:
        timed = self.records.get("speed", Record()).figures.get("timed", {})
        return [f"## Speed at {title}\n\n{_table(methods)}" for title, methods in timed.items()]


def _table(methods: dict[str, dict[str, dict[str, float]]]) -> str:
    """Frames of each kind, then stages from the slowest on: median milliseconds, a column a method.

    Of a stage in brackets what the CPU takes to issue it.
    """
    rows = [f"| ms | {' | '.join(methods)} |", f"|---|{'--:|' * len(methods)}"]
    for key, kind in (("frames_ms", "frame, "), ("stages_ms", "")):
        longest: dict[str, float] = {}
        for timing in methods.values():
            for name, milliseconds in timing[key].items():
                longest[name] = max(milliseconds, longest.get(name, 0.0))
        for name in sorted(longest, key=longest.__getitem__, reverse=True):
            cells = [_cell(timing, key, name) for timing in methods.values()]
            rows.append(f"| {kind}{name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(timing: dict[str, dict[str, float]], key: str, name: str) -> str:
    if name not in timing[key]:
        return ""
    submit_ms = timing["submit_ms"].get(name) if key == "stages_ms" else None
    return f"{timing[key][name]:.2f}" + ("" if submit_ms is None else f" ({submit_ms:.2f})")


def _verb(state: State) -> str:
    return {State.OUT_OF_TIME: "ran out of time", State.RUNNING: "did not end"}.get(state, str(state))
