"""What a step found: written by the step's process as it goes along, read by the one that started it."""

import json
import time
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes


class State(StrEnum):
    """How far a step came."""

    RUNNING = "running"
    PASSED = "passed"
    FAILED = "failed"
    OUT_OF_TIME = "out of time"
    SKIPPED = "skipped"


class Skipped(Exception):  # noqa: N818 (no error)
    """Raised by a step that cannot be taken on this machine; its text is a sentence that says why."""


@dataclass
class Record:
    """A step's findings: one sentence, what was wrong (a sentence each), and figures as plain data."""

    state: State = State.RUNNING
    sentence: str = ""
    faults: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def is_bad(self) -> bool:
        """Whether the step neither passed nor was left out."""
        return self.state not in (State.PASSED, State.SKIPPED)

    def as_dict(self) -> dict[str, Any]:
        """Returns the record as plain data."""
        return asdict(self)


@dataclass
class Findings:
    """The record that a running step fills.

    `keep` writes it into the file that the waiting process reads. Pictures go into `out`, files of the moment into
    `scratch`.
    """

    path: Path
    out: Path
    scratch: Path
    record: Record = field(default_factory=Record)
    _began_s: float = field(default_factory=time.monotonic, init=False)

    def keep(self, sentence: str = "", **figures: object) -> None:
        """Adds figures and writes the record; `sentence` says how far the step is."""
        self.record.sentence = sentence or self.record.sentence
        self.record.figures |= figures
        write_bytes(self.path, json.dumps(self.record.as_dict()).encode())

    def done(self, what: str) -> None:
        """Notes after how many seconds a part of the step was done: where time runs out, that tells what took it."""
        seconds = round(time.monotonic() - self._began_s, 1)
        self.keep(done_after_s={**self.record.figures.get("done_after_s", {}), what: seconds})

    def fault(self, sentence: str) -> None:
        """Notes something wrong: the step fails at its end."""
        self.record.faults.append(" ".join(sentence.split()))
        self.keep()

    def end(self, state: State, sentence: str) -> None:
        """Writes the record for the last time."""
        self.record.state = state
        self.keep(sentence)


def fault_sentence(fault: Exception) -> str:
    """Returns what an exception says, with its kind where that is not written for users."""
    kind = "" if isinstance(fault, DeltalightError) else f"{type(fault).__name__}, "
    return f"{kind}{fault}"


def read_record(path: Path) -> Record:
    """Returns what a step wrote; nothing yet is an empty record."""
    if not path.exists():
        return Record()
    found = json.loads(path.read_bytes())
    return Record(**{**found, "state": State(found["state"])})
