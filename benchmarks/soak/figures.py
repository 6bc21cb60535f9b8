"""Figures of a soak, from samples, pictures and outcomes of faults."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.soak.crowd import Flow, Seen
from deltalight.benchmarks.soak.faults import LARGEST_DIFFERENCE
from deltalight.benchmarks.soak.profiles import Profile
from deltalight.benchmarks.soak.report import Bar, FaultRecord, Figure, period_bar, worst
from deltalight.benchmarks.soak.samples import (
    ProcessSample,
    Sample,
    objects_of_server,
    of_process,
    steady_spans,
)
from deltalight.benchmarks.soak.station import SERVER, WEB

SETTLED_AFTER_S = 60.0  # from when on memory should not grow
LOOSE_HANDLES = 2  # connections that open and close as they are needed
GROWTH = 5.0  # per cent

BACK = Bar("< 3 s", lambda value: value < 3.0)
BACK_FROM_CUT = Bar("< 1 s", lambda value: value < 1.0)
NONE = Bar("0", lambda value: value == 0)
ALL = Bar("every time", lambda value: value == 1)
SHOWN = Bar("shown", lambda _value: True)
LOST = Bar("<= 1 s", lambda value: value <= 1.0)


@dataclass(frozen=True)
class Soaked:
    """What a soak collected; times are of the monotonic clock, `calm` are the spans without a fault."""

    profile: Profile
    samples: Sequence[Sample]
    calm: Sequence[tuple[float, float]]
    seen: Sequence[Seen]
    faults: Sequence[FaultRecord]
    deaths: Mapping[str, int]
    orphans: int
    cameras: Sequence[str]

    def is_calm(self, at_s: float) -> bool:
        """Whether there was no fault then."""
        return any(began_s <= at_s < ended_s for began_s, ended_s in self.calm)


def all_figures(soaked: Soaked) -> list[Figure]:
    """Returns the table; what was not measured is left out."""
    outcomes = _Outcomes(soaked.faults)
    lost_s = outcomes.of("kill-recorder", "lost_s")
    figures = [
        worst("crashes", "deaths that no fault caused, by process", list(soaked.deaths.values()), NONE, ""),
        worst("orphans", "processes that outlived the station", [soaked.orphans], NONE, ""),
        *_resources(soaked),
        _age(soaked),
        _rate(soaked),
        *_kills(outcomes),
        *_spares(outcomes),
        *_loads(outcomes, soaked.profile),
        *_links(outcomes),
        worst("lost of a recording", "SIGKILL of the recorder", lost_s, LOST, "s"),
    ]
    return [each for each in figures if each is not None]


class _Outcomes:
    """Values of faults by the fault's name and the outcome's key."""

    def __init__(self, faults: Sequence[FaultRecord]) -> None:
        self._faults = faults

    def of(self, name: str, *path: str) -> list[float]:
        """Returns the values at a path of all faults of that name; those that are None are left out."""
        found = []
        for fault in self._faults:
            value: Any = fault.outcome if fault.name == name else None
            for key in path:
                value = None if value is None else value.get(key)
            if value is not None:
                found.append(float(value))
        return found


def _resources(soaked: Soaked) -> list[Figure | None]:
    growths, handles = [], []
    for name, span in steady_spans(soaked.samples, soaked.is_calm, SETTLED_AFTER_S):
        own = [process for _, process in of_process(span, name)]
        growths.append(100 * (own[-1].rss_bytes / own[0].rss_bytes - 1))
        handles.append(float(own[-1].handles - own[0].handles))
    objects = [float(max(each) - each[0]) for each in objects_of_server(soaked.samples, SETTLED_AFTER_S)]
    after = f"calm samples of one process, from {SETTLED_AFTER_S:.0f} s after its start to its last"
    began = f"of one render server, from {SETTLED_AFTER_S:.0f} s after its start on"
    few = Bar(f"<= {LOOSE_HANDLES} more", lambda value: value <= LOOSE_HANDLES)
    return [
        worst("growth of memory (RSS)", after, growths, Bar(f"< {GROWTH:g} %", lambda v: v < GROWTH), "%"),
        worst("growth of open handles", after, handles, few, ""),
        worst("growth of GL objects", began, objects, NONE, ""),
    ]


def _age(soaked: Soaked) -> Figure | None:
    ages = [each.age_ms - each.waiting_ms for each in soaked.seen if soaked.is_calm(each.at_s)]
    p95_ms = [float(np.percentile(ages, 95))] if ages else []
    how = f"95 of 100 of {len(ages)} pictures without a fault"
    return worst("age of a picture without waiting", how, p95_ms, period_bar(soaked.profile), "ms")


def _rate(soaked: Soaked) -> Figure | None:
    """Pictures a second of each camera, over all that was calm."""
    calm_s = sum(ended_s - began_s for began_s, ended_s in soaked.calm)
    counts = Counter(each.camera for each in soaked.seen if soaked.is_calm(each.at_s))
    rates = [counts[name] / calm_s for name in soaked.cameras] if calm_s else []
    how = f"without a fault, of {soaked.profile.frames_per_s:g} that its node sends"
    return worst("pictures a second of a camera", how, rates, SHOWN, "")


def _kills(outcomes: _Outcomes) -> list[Figure | None]:
    names = {"kill-node": "node", "kill-server": SERVER, "kill-web": WEB}
    figures = [
        worst(f"picture back, {who}", "SIGKILL", outcomes.of(name, "back_s"), BACK, "s")
        for name, who in names.items()
    ]
    same = [value for name in names for value in outcomes.of(name, "same_document")]
    apart = [value for name in names for value in outcomes.of(name, "difference")]
    alike = Bar(f"<= {LARGEST_DIFFERENCE:g}", lambda value: value <= LARGEST_DIFFERENCE)
    figures += [
        worst("scene equal by document", "after SIGKILL, 1 = equal", same, ALL, "", smallest=True),
        worst("scene equal by pixels", "after SIGKILL, mean difference of codes", apart, alike, "codes"),
    ]
    return figures + [
        worst(f"picture back, {who}", "SIGSTOP, from SIGCONT on", outcomes.of(name, "back_s"), BACK, "s")
        for name, who in (("stop-node", "node"), ("stop-server", SERVER), ("stop-web", WEB))
    ]


def _spares(outcomes: _Outcomes) -> list[Figure | None]:
    """How long the next spare of a killed render server takes, and what others notice of it."""
    name, how = "kill-server", "until the next spare of the render server is ready"
    ready_s, rates, ages_ms = (
        outcomes.of(name, *path)
        for path in (("spare_ready_s",), ("meanwhile", "frames_per_s"), ("meanwhile", "unwaited_p95_ms"))
    )
    return [
        worst("spare ready", "after the picture is back", ready_s, SHOWN, "s"),
        worst("pictures a second of all cameras", how, rates, SHOWN, "", smallest=True),
        worst("age without waiting, 95 of 100", how, ages_ms, SHOWN, "ms"),
    ]


def _loads(outcomes: _Outcomes, profile: Profile) -> list[Figure | None]:
    near = Bar("within 5 %", lambda value: value <= 5.0)
    figures: list[Figure | None] = []
    by_themselves: list[float] = []
    for name, what in (
        ("viewers", "slow, silent and never acknowledging viewers"),
        ("churn", "viewers that join and leave"),
        ("nonsense", "a node that sends nonsense"),
    ):
        before, during, after = (
            np.array(outcomes.of(name, when, "frames_per_s")) for when in ("before", "during", "after")
        )
        calm = (before + after) / 2
        changes = _per_cent(during - calm, calm)
        by_themselves += _per_cent(after - before, calm)
        ages_ms = outcomes.of(name, "during", "unwaited_p95_ms")
        figures += [
            worst("change of others' rate", f"{what}, against before and after", changes, near, "%"),
            worst("others' age without waiting, 95 of 100", what, ages_ms, period_bar(profile), "ms"),
        ]
    how = "from the calm span before each of these loads to that after it, equally long"
    return [*figures, worst("change of the rate by itself", how, by_themselves, SHOWN, "%")]


def _per_cent(changes: Float64[np.ndarray, " n"], of: Float64[np.ndarray, " n"]) -> list[float]:
    return [float(each) for each in 100 * np.abs(changes)[of > 0] / of[of > 0]]


def _links(outcomes: _Outcomes) -> list[Figure | None]:
    figures = [
        worst("picture back after a cut", "5 s, all links", outcomes.of("cut", "back_s"), BACK_FROM_CUT, "s")
    ]
    for name, what in (
        ("link-arm", "25 Mbit/s, 20±10 ms, 0.5 % lost"),
        ("link-foxglove", "80±20 ms, 2 % lost"),
        ("link-lossy", "25 Mbit/s, 20±10 ms, 30 % lost"),
        ("link-reorder", "25 Mbit/s, 20±10 ms, 25 % overtaken"),
        ("cut", "5 s cut and the time after it"),
    ):
        for when, how in (("during", ""), ("newest", ", no rendering"), ("queued", ", everything queued")):
            figures += _flow_figures(outcomes, (name, when), what + how)
    return figures


def _flow_figures(outcomes: _Outcomes, path: tuple[str, str], what: str) -> list[Figure | None]:
    return [
        worst(title, what, outcomes.of(*path, key), SHOWN, unit)
        for key, title, unit in (
            ("age_p50_ms", "age, median", "ms"),
            ("age_p95_ms", "age, 95 of 100", "ms"),
            ("longest_gap_s", "longest gap", "s"),
        )
    ]


def all_courses(
    samples: Sequence[Sample], seen: Sequence[Seen], names: Sequence[str], cameras: Sequence[str]
) -> dict[str, dict[str, list[float | None]]]:
    """Returns what is plotted, by panel and line, at the times of the samples."""
    flows = [Flow.of(own, *span, cameras) for span, own in _by_sample(samples, seen)]

    def of_each(read: Callable[[ProcessSample], float]) -> dict[str, list[float | None]]:
        known = {name: [sample.processes.get(name) for sample in samples] for name in names}
        return {
            name: _rounded(None if each is None else read(each) for each in processes)
            for name, processes in known.items()
        }

    return {
        "age, ms": {
            "median": _rounded(flow.age_p50_ms for flow in flows),
            "95 of 100": _rounded(flow.age_p95_ms for flow in flows),
        },
        "pictures a second": {
            name: _rounded(flow.camera_frames_per_s[name] for flow in flows) for name in cameras
        },
        "RSS, MB": of_each(lambda process: process.rss_bytes / 1e6),
        "open handles": of_each(lambda process: process.handles),
        "GL objects": {SERVER: _rounded(each.gl_objects for each in samples)},
        "drops since the start": {"all": _rounded(each.drops for each in samples)},
    }


def _rounded(values: Iterable[float | None]) -> list[float | None]:
    return [None if value is None else round(value, 1) for value in values]


def _by_sample(
    samples: Sequence[Sample], seen: Sequence[Seen]
) -> Iterable[tuple[tuple[float, float], list[Seen]]]:
    """Yields the span that ends with each sample, and the pictures in it."""
    number = 0
    for before, sample in zip([None, *samples], samples, strict=False):
        began_s = sample.at_s - 1.0 if before is None else before.at_s
        own = []
        while number < len(seen) and seen[number].at_s < sample.at_s:
            if seen[number].at_s >= began_s:
                own.append(seen[number])
            number += 1
        yield (began_s, sample.at_s), own
