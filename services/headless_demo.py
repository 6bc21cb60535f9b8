"""The demo without its dashboard: pictures, a contact sheet, a video and figures in a folder."""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.services import ports
from deltalight.services.child import NODE, SERVER
from deltalight.services.collector import CompositeCollector, summarize
from deltalight.services.demo import demo_plan, demo_scene
from deltalight.services.process import Process
from deltalight.services.progress import Progress
from deltalight.services.session_file import session_file
from deltalight.services.supervisor import POLL_INTERVAL_S, Supervisor

FIRST_FRAME_PATIENCE_S = 120.0  # in which no process is at work
PATIENCE_S = 60.0
LONGEST_FRAME_S = 1800.0  # after it whoever is still at work hangs


def run_headless(
    method: str, frames: int, out: Path, *, as_json: bool, spares: Mapping[str, Process]
) -> None:
    """Collects `frames` composites in the folder `out`, with a contact sheet and a video, and prints a summary.

    `spares` become the demo's processes, by name.

    Raises:
        DeltalightError: the output cannot be written, a process died for good, or no composites came.
    """
    summary = collect_composites(demo_scene(method), frames, out, spares)
    if as_json:
        print(json.dumps(summary))
    else:
        _print_summary(summary, out)


def collect_composites(
    scene: SceneDocument, frames: int, out: Path | None, spares: Mapping[str, Process] | None = None
) -> dict[str, Any]:
    """Plays the demo's recording through real processes and collects composites (into `out`, if given).

    Raises:
        DeltalightError: a process died for good, or composites stopped coming.
    """
    with session_file(scene) as session:
        plan = demo_plan(session)
        composites = ports.endpoint(plan.composite_port)
        with (
            Supervisor(plan.specs(), spares=spares) as supervisor,
            Progress({NODE: ports.endpoint(plan.node_port), SERVER: composites}) as progress,
        ):
            collector = CompositeCollector(composites, ports.endpoint(plan.control_port), out)
            try:
                _collect(collector, supervisor, progress, frames)
                summary = summarize(collector, supervisor.restarts())
            finally:
                collector.close()
    if out is not None:
        collector.write_overview()
    return summary


def _collect(collector: CompositeCollector, supervisor: Supervisor, progress: Progress, frames: int) -> None:
    """Takes composites until there are `frames`; waits while a process starts or is at work on the next one."""
    came_s = time.monotonic()
    while collector.count < frames:
        supervisor.poll()
        if collector.take(POLL_INTERVAL_S, frames):
            came_s = time.monotonic()
        progress.look(supervisor.process_ids())
        waited_s = time.monotonic() - came_s
        idle_s = min(waited_s, time.monotonic() - progress.at_work_s)
        patience_s = PATIENCE_S if collector.count else FIRST_FRAME_PATIENCE_S
        if idle_s > patience_s or waited_s > LONGEST_FRAME_S:
            raise DeltalightError(
                f"Only {collector.count} of {frames} composites arrived, and none in the last {waited_s:.0f} s;"
                " see the lines above."
            )


def _print_summary(summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("Measure", "Value", title="Demo", title_justify="left")
    table.columns[1].justify = "right"
    for name, value in summary.items():
        if name != "pass_times_ms":
            table.add_row(name.replace("_", " "), _shown(value))
    for name, milliseconds in summary["pass_times_ms"].items():
        table.add_row(f"pass {name}, ms", f"{milliseconds:.2f}")
    console = Console()
    console.print(table)
    console.print(f"Composites, contact sheet and video are in {out}")


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {count}" for key, count in value.items() if count) or "none"
    return f"{value:.1f}" if isinstance(value, float) else str(value)
