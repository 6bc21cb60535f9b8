"""One step in a process of its own: `python -m deltalight.benchmarks.gpu_check.child MODULE:FUNCTION RECORD OUT`."""

import importlib
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from deltalight.benchmarks.gpu_check.record import Findings, Skipped, State
from deltalight.protocol.errors import DeltalightError
from deltalight.services.parent_death_signal import end_with_supervisor

Step = Callable[[Findings], str]
"""A step fills the findings and returns its closing sentence."""


def take_step(target: str, findings: Findings) -> None:
    """Runs the step and writes its record, whatever it raises."""
    try:
        sentence = _step(target)(findings)
    except Skipped as reason:
        findings.end(State.SKIPPED, str(reason))
    except ModuleNotFoundError as missing:
        findings.end(State.FAILED, f"the Python module {missing.name} is not installed")
    except DeltalightError as fault:
        findings.end(State.FAILED, str(fault))
    except Exception as fault:
        traceback.print_exc()
        findings.end(State.FAILED, f"{type(fault).__name__}: {fault}")
    else:
        findings.end(State.FAILED if findings.record.faults else State.PASSED, sentence)


def _step(target: str) -> Step:
    module, _, name = target.partition(":")
    step: Step = getattr(importlib.import_module(module), name)
    return step


def main() -> None:
    """Takes the step that the command line names."""
    end_with_supervisor()
    target, record, out = sys.argv[1:]
    with TemporaryDirectory(prefix="deltalight-gpu-check-") as scratch:
        take_step(target, Findings(Path(record), Path(out), Path(scratch)))


if __name__ == "__main__":
    main()
