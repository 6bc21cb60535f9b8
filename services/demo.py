"""The demo: the shipped recording through node, render server and web process, each a process of its own."""

import json
import os
import shutil
import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.method_names import with_method
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.services import ports
from deltalight.services.collector import CompositeCollector, summarize
from deltalight.services.files import make_output_folder
from deltalight.services.host import HostPlan
from deltalight.services.host_store import activate_document, session_file
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import POLL_INTERVAL_S, Supervisor

ASSETS = Path(__file__).parent / "demo_assets"
RECORDING = ASSETS / "demo.mcap"
SCENE = ASSETS / "scene.json"
POSTER = ASSETS / "poster.jpg"
NAME = "Demo"
FRAME_BUDGET_MS = 125.0  # of what a viewer calls live: eight pictures a second
FIRST_FRAME_TIMEOUT_S = 120.0  # a cold shader cache on a slow machine takes a while
BETWEEN_FRAMES_TIMEOUT_S = 60.0
SLOWER = 3.0  # than the slowest frame before may the next one be
LONGEST_FRAME_S = 1800.0  # after it a renderer that still answers hangs


def demo_scene(method: str) -> SceneDocument:
    """Return the demo's scene with a method of `deltalight.protocol.method_names`.

    Raises:
        DeltalightError: the demo's files are missing.
    """
    if not all(path.is_file() for path in (RECORDING, SCENE, POSTER)):
        raise DeltalightError(f"The demo's files are missing in {ASSETS}; install Deltalight again.")
    scene = load_scene(SCENE)
    return with_method(scene, method)


def run_live(method: str, *, port: int, with_browser: bool) -> None:
    """Run the demo with its dashboard until Ctrl-C; changes are not kept.

    Raises:
        DeltalightError: a port is in use, or a process died for good.
    """
    ports.require_free(port, "dashboard", "--port")
    with TemporaryDirectory(prefix="deltalight-demo-") as data, _kept(method, Path(data)) as session:
        plan = replace(demo_plan(session), data=Path(data), page_port=port)
        plan.require_free_ports()
        address = f"http://{ports.LOOPBACK}:{port}"
        with Supervisor(plan.specs()) as supervisor:
            print(f"The dashboard is at {address} (Ctrl-C ends the demo).", flush=True)
            supervisor.run(until=lambda: ports.answers(port))
            if with_browser and _has_display():
                webbrowser.open(address)
            supervisor.run()


@contextmanager
def _kept(method: str, data: Path) -> Iterator[Path]:
    """Yield the session file of the demo's scene; a data folder stores the scene too, as the active one."""
    with Store(data) as store:
        scene = demo_scene(method)
        paced = scene.replaced(
            name=NAME,
            method=scene.method.replaced(quality="live"),
            output=scene.output.replaced(frame_budget_ms=FRAME_BUDGET_MS),
        )
        scene = activate_document(store, paced)
        shutil.copyfile(POSTER, store.poster)
    with session_file(scene) as session:
        yield session


def run_headless(method: str, frames: int, out: Path, *, as_json: bool) -> None:
    """Collect `frames` composites in `out`, with a contact sheet and a video, and print a summary.

    Raises:
        DeltalightError: the output cannot be written, a process died for good, or no composites came.
    """
    scene = demo_scene(method)
    make_output_folder(out)
    summary = collect_composites(scene, frames, out)
    if as_json:
        print(json.dumps(summary))
    else:
        _print_summary(summary, out)


def collect_composites(scene: SceneDocument, frames: int, out: Path | None) -> dict[str, Any]:
    """Play the demo's recording through real processes and collect composites (into `out`, if given).

    Raises:
        DeltalightError: a process died for good, or composites stopped coming.
    """
    with session_file(scene) as session:
        plan = demo_plan(session)
        with Supervisor(plan.specs()) as supervisor:
            collector = CompositeCollector(
                ports.endpoint(plan.composite_port), ports.endpoint(plan.control_port), out
            )
            try:
                _collect(collector, supervisor, frames)
                summary = summarize(collector, supervisor.restarts())
            finally:
                collector.close()
    if out is not None:
        collector.write_overview()
    return summary


def _collect(collector: CompositeCollector, supervisor: Supervisor, frames: int) -> None:
    """Take composites until there are `frames`; wait for as long as the renderer is at work on the next one."""
    waiting_since_s = time.monotonic()
    while collector.count < frames:
        supervisor.poll()
        if collector.take(POLL_INTERVAL_S, frames):
            waiting_since_s = time.monotonic()
        waited_s = time.monotonic() - waiting_since_s
        if waited_s > _patience_s(collector) and (waited_s > LONGEST_FRAME_S or not collector.is_rendering()):
            raise DeltalightError(
                f"Only {collector.count} of {frames} composites arrived, and none in the last {waited_s:.0f} s;"
                " see the lines above."
            )


def _patience_s(collector: CompositeCollector) -> float:
    """Return how long the next composite may take before the renderer is asked whether it is at work."""
    if collector.count == 0:
        return FIRST_FRAME_TIMEOUT_S
    return max(BETWEEN_FRAMES_TIMEOUT_S, SLOWER * collector.slowest_s)


def demo_plan(session: Path) -> HostPlan:
    """Return the demo's processes without the web process, connected by ports of their own."""
    node_port, composite_port, control_port = ports.private_ports(3)
    return HostPlan(
        str(RECORDING),
        session,
        node_port=node_port,
        composite_port=composite_port,
        control_port=control_port,
        allow_software=True,
        log_level="warning",
    )


def _has_display() -> bool:
    """Whether there is a display; without one, `webbrowser` would start a text browser in this terminal."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


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
