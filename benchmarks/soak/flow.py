"""How pictures flowed to a viewer in a span."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from deltalight.benchmarks.soak.crowd import Seen


@dataclass(frozen=True)
class Flow:
    """Pictures that the measuring viewer got in a span: a second, ages in ms, and the longest wait for one in s."""

    frames_per_s: float
    age_p50_ms: float | None
    age_p95_ms: float | None
    unwaited_p95_ms: float | None = field(metadata={"what": "of the ages without waiting for the renderer"})
    longest_gap_s: float

    @classmethod
    def of(cls, seen: Sequence[Seen], began_s: float, ended_s: float) -> "Flow":
        """Describe pictures that came between two moments."""
        moments = [began_s, *(each.at_s for each in seen), ended_s]
        ages = [each.age_ms for each in seen]
        unwaited = [each.age_ms - each.waiting_ms for each in seen]
        return cls(
            len(seen) / (ended_s - began_s),
            _percentile(ages, 50),
            _percentile(ages, 95),
            _percentile(unwaited, 95),
            float(np.max(np.diff(moments))),
        )


def _percentile(values: Sequence[float], share: float) -> float | None:
    return float(np.percentile(values, share)) if values else None
