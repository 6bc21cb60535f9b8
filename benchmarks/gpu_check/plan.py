"""Which steps `deltalight gpu-check` takes, in which order, and how long each may."""

from dataclasses import dataclass
from difflib import get_close_matches

from deltalight.protocol.errors import DeltalightError

STEPS_MODULE = "deltalight.benchmarks.gpu_check.steps"


@dataclass(frozen=True)
class Step:
    """A step: what its process runs (MODULE:FUNCTION), and its budget, to which comes what earlier steps left."""

    name: str
    target: str
    budget_s: float


MACHINE = Step("machine", f"{STEPS_MODULE}:machine", 15)
"""Taken first whatever is chosen: it tells whose figures the others are."""
BUDGETS_S = {
    "doctor": 15,
    "shaders": 110,
    "pictures": 80,
    "speed": 90,
    "leaks": 30,
    "memory": 20,
    "tests": 80,
    "slow-tests": 15,
    "quality": 25,
}
"""In the order in which they are taken: first what the driver compiles for all, then by worth."""
STEPS = [
    Step(name, f"{STEPS_MODULE}:{name.replace('-', '_')}", budget_s) for name, budget_s in BUDGETS_S.items()
]


def choose_steps(text: str | None) -> list[Step]:
    """Returns the steps of a list of names separated by commas, in the order of STEPS; None is all of them.

    Raises:
        DeltalightError: one is unknown.
    """
    names = list(BUDGETS_S) if text is None else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in BUDGETS_S:
            nearest = get_close_matches(name, BUDGETS_S, 1, cutoff=0)[0]
            raise DeltalightError(
                f"'{name}' is not a step of gpu-check; the nearest is {nearest}, of {', '.join(BUDGETS_S)}."
            )
    return [step for step in STEPS if step.name in names]
