"""The demo with its dashboard: the shipped recording through node, render server and web process."""

import os
import shutil
import sys
import webbrowser
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from deltalight.services import ports
from deltalight.services.demo import NAME, POSTER, POSTER_BEFORE, RECORDING, demo_plan, demo_scene
from deltalight.services.files import make_output_folder
from deltalight.services.host_store import activate_document
from deltalight.services.process import Process
from deltalight.services.session_file import session_file
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import Supervisor

FRAME_BUDGET_MS = 125.0  # of what a viewer calls live: eight pictures a second


def run_live(method: str, *, port: int, with_browser: bool, spares: Mapping[str, Process]) -> None:
    """Runs the demo with its dashboard until Ctrl-C; changes are not kept. `spares` become its processes, by name.

    Raises:
        DeltalightError: a port is in use, or a process died for good.
    """
    with TemporaryDirectory(prefix="deltalight-demo-") as data, _kept(method, Path(data)) as session:
        plan = demo_plan(session)
        taken = (plan.node_port, plan.composite_port, plan.control_port, port)
        (playback_port,) = ports.private_ports(1, avoid=taken)
        plan = replace(plan, data=Path(data), page_port=port, playback_port=playback_port)
        plan.require_free_ports()
        address = f"http://{ports.LOOPBACK}:{port}"
        with Supervisor(plan.specs(), spares=spares) as supervisor:
            supervisor.run(until=lambda: ports.answers(port))
            print(f"The dashboard is at {address} (press Ctrl-C to stop).", flush=True)
            if with_browser and _has_display():
                webbrowser.open(address)
            supervisor.run()


@contextmanager
def _kept(method: str, data: Path) -> Iterator[Path]:
    """Yields the session file of the demo's scene; a data folder stores the scene too, as the active one."""
    with Store(data) as store:
        scene = demo_scene(method)
        paced = scene.replaced(
            name=NAME,
            method=scene.method.replaced(quality="live"),
            output=scene.output.replaced(frame_budget_ms=FRAME_BUDGET_MS),
        )
        scene = activate_document(store, paced)
        shutil.copyfile(POSTER, store.poster)
        shutil.copyfile(POSTER_BEFORE, store.poster_before)
        folder = make_output_folder(store.recordings)
        (folder / RECORDING.name).symlink_to(RECORDING)  # replayed, the camera is moved by hand
    with session_file(scene) as session:
        yield session


def _has_display() -> bool:
    """Whether there is a display; without one, `webbrowser` would start a text browser in this terminal."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
