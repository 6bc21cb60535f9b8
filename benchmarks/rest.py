"""Response times of the web process, with and without rendering on the same machine, and the cost of its viewers."""

import asyncio
import gzip
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
from rich.console import Console
from rich.table import Table

from deltalight.benchmarks.rest_load import Call, send_paced, watch
from deltalight.benchmarks.rest_usage import CLIENTS, WEB, Sample, Usage, next_picture, sample
from deltalight.protocol.errors import DeltalightError
from deltalight.services import ports
from deltalight.services.api.static_page import DASHBOARD
from deltalight.services.demo import demo_plan, demo_scene
from deltalight.services.host import HostPlan
from deltalight.services.host_store import activate_document
from deltalight.services.offline import with_output
from deltalight.services.session_file import session_file
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import Supervisor

REQUESTS_PER_S = 50.0
VIEWERS, VIEWER_FRAMES_PER_S = 20, 10.0
ROUNDS = 3  # of viewers after none: other load of the machine affects both
START_TIMEOUT_S = 120.0  # a cold shader cache on a slow machine takes a while
STEP_M = 0.001  # of the object that the requests move
TEXT_SUFFIXES = (".js", ".css", ".html", ".svg")  # fonts are compressed already


def measure_rest(seconds: float, *, size: tuple[int, int] | None, device: int | None) -> dict[str, Any]:
    """Measures requests, viewers and the page's size; each measurement takes `seconds`.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a process that died for good.
    """
    report: dict[str, Any] = {
        "cpus": os.cpu_count(),
        "load_before": os.getloadavg()[0],
        "seconds": seconds,
        "requests_per_s": REQUESTS_PER_S,
    }
    with _running(size, device, with_rendering=False) as (client, _):
        report["without_rendering"] = _requests(client, seconds, sample)
    with _running(size, device, with_rendering=True) as (client, supervisor):
        _wait_for_pictures(client, supervisor)
        report["with_rendering"] = _requests(client, seconds, next_picture)
        report["viewers"] = _viewers(client, seconds)
        report |= _picture(client)
    report["dashboard"] = dashboard_sizes(DASHBOARD)
    return report


@contextmanager
def _running(
    size: tuple[int, int] | None, device: int | None, *, with_rendering: bool
) -> Iterator[tuple[httpx.Client, Supervisor]]:
    """Starts the demo's processes, or the web process alone, with a data folder of their own; a client of the API."""
    scene = with_output(demo_scene("dvct"), size, None)
    with TemporaryDirectory(prefix="deltalight-bench-") as folder:
        data = Path(folder)
        with Store(data) as store:
            shown = activate_document(store, scene)
        with session_file(shown) as session:
            (port,) = ports.private_ports(1)
            plan: HostPlan = replace(demo_plan(session), data=data, page_port=port, device=device)
            with Supervisor(plan.specs() if with_rendering else plan.specs()[-1:]) as supervisor:
                supervisor.run(until=lambda: ports.answers(port))
                with httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1") as client:
                    yield client, supervisor


def _wait_for_pictures(client: httpx.Client, supervisor: Supervisor) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S

    def comes() -> bool:
        if time.monotonic() > deadline_s:
            raise DeltalightError("No picture came from the render server; see the lines above.")
        return sample(client).frames >= 2

    supervisor.run(until=comes)


def _requests(client: httpx.Client, seconds: float, mark: Callable[[httpx.Client], Sample]) -> dict[str, Any]:
    """Reads four times, then moves the shown scene's object once, repeatedly; counts pictures between two marks."""
    scene = client.get("/active-scene").raise_for_status().json()
    path, thing = f"/scenes/{scene['id']}", scene["document"]["objects"][0]
    x, y, z = thing["pose"]["translation_m"]
    moves = [{"pose": {"translation_m": [x + STEP_M * step, y, z]}} for step in (1, 2, 1, 0)]
    calls = [
        Call("GET", path),
        Call("GET", "/state"),
        Call("GET", f"{path}/revisions"),
        Call("GET", "/scenes"),
        Call("PATCH", f"{path}/objects/{thing['id']}", moves),
    ]
    usage, started = Usage(), mark(client)
    times = asyncio.run(send_paced(_address(client), calls, REQUESTS_PER_S, seconds))
    usage.add(started, sample(client), mark(client))
    return {**times.figures(), "frames_per_s": usage.frames_per_s, "cores": usage.cores}


def _viewers(client: httpx.Client, seconds: float) -> dict[str, Any]:
    """Measures many viewers against none, in turn: pictures rendered per second, and processor time."""
    alone, watched, got = Usage(), Usage(), list[int]()
    for _ in range(ROUNDS):
        started = next_picture(client)
        time.sleep(seconds)
        alone.add(started, sample(client), next_picture(client))
        started = next_picture(client)
        got.extend(asyncio.run(watch(_address(client), VIEWERS, VIEWER_FRAMES_PER_S, seconds)))
        watched.add(started, sample(client), next_picture(client))
    more = {name: watched.cores[name] - alone.cores[name] for name in (WEB, CLIENTS)}
    return {
        "viewers": VIEWERS,
        "frames_per_s_each_at_most": VIEWER_FRAMES_PER_S,
        "frames_per_s_each": sum(got) / (len(got) * seconds),
        "rendered_per_s_without": alone.frames_per_s,
        "rendered_per_s_with": watched.frames_per_s,
        "ratio": watched.frames_per_s / alone.frames_per_s,
        "cores_without": alone.cores,
        "cores_with": watched.cores,
        "share_of_processors": {name: cores / (os.cpu_count() or 1) for name, cores in more.items()},
        "web_ms_per_frame_and_viewer": 1e3 * more[WEB] * watched.wall_s / max(1, sum(got)),
    }


def _address(client: httpx.Client) -> str:
    return str(client.base_url).removesuffix("/")


def _picture(client: httpx.Client) -> dict[str, Any]:
    """Returns the renderer's name and the size of its pictures."""
    import cv2
    import numpy as np

    jpeg = client.get("/live.jpg").raise_for_status().content
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    processes = client.get("/nodes").raise_for_status().json()
    renderer = next((each["detail"] for each in processes if each["kind"] == "render_server"), "")
    return {"renderer": renderer, "size": [picture.shape[1], picture.shape[0]]}


def dashboard_sizes(folder: Path) -> dict[str, Any] | None:
    """Returns the bytes of the built dashboard's files, plain and gzipped; None = it is not built."""
    if not (folder / "index.html").is_file():
        return None
    files = {}
    for path in sorted(each for each in folder.rglob("*") if each.is_file()):
        content = path.read_bytes()
        sent = len(gzip.compress(content)) if path.suffix in TEXT_SUFFIXES else len(content)
        files[path.relative_to(folder).as_posix()] = {"bytes": len(content), "gzipped_bytes": sent}
    total = sum(each["gzipped_bytes"] for each in files.values())
    return {"gzipped_bytes": total, "files": files}


def print_report(report: dict[str, Any]) -> None:
    """Prints the report as tables."""
    console = Console()
    width, height = report["size"]
    console.print(
        f"{report['renderer']}, {report['cpus']} CPUs, {width}x{height}, {report['seconds']:g} s each"
    )
    console.print(f"load of the machine before: {report['load_before']:.1f}")
    console.print(_request_table(report))
    _print_viewers(console, report)
    _print_dashboard(console, report["dashboard"])


def _request_table(report: dict[str, Any]) -> Table:
    title = f"{report['requests_per_s']:g} requests/s"
    table = Table("", "Request", "p50 ms", "p99 ms", title=title, title_justify="left")
    for column in table.columns[2:]:
        column.justify = "right"
    for key, meaning in (
        ("without_rendering", "web process alone"),
        ("with_rendering", "beside the renderer"),
    ):
        figures = report[key]
        for method in ("GET", "PATCH"):
            if method in figures:
                one = figures[method]
                table.add_row(meaning, method, f"{one['p50_ms']:.1f}", f"{one['p99_ms']:.1f}")
        if figures["failed"]:
            table.add_row(meaning, "failed", str(figures["failed"]), "")
    return table


def _print_viewers(console: Console, report: dict[str, Any]) -> None:
    figures, used = report["viewers"], report["viewers"]["share_of_processors"]
    console.print(f"rendered beside these requests: {report['with_rendering']['frames_per_s']:.2f} frames/s")
    console.print(
        f"rendered with nobody looking {figures['rendered_per_s_without']:.2f} frames/s, with {figures['viewers']} "
        f"viewers {figures['rendered_per_s_with']:.2f} frames/s (ratio {figures['ratio']:.2f}); each got "
        f"{figures['frames_per_s_each']:.2f} frames/s of at most {figures['frames_per_s_each_at_most']:g}"
    )
    console.print(
        f"for the viewers the web process took {100 * used[WEB]:.1f} % of the processors "
        f"({figures['web_ms_per_frame_and_viewer']:.2f} ms a frame and viewer), the viewers themselves "
        f"{100 * used[CLIENTS]:.1f} %"
    )


def _print_dashboard(console: Console, sizes: dict[str, Any] | None) -> None:
    if sizes is None:
        console.print("the dashboard is not built; `./run api` builds it")
        return
    console.print(f"dashboard: {sizes['gzipped_bytes'] / 1e3:.0f} kB gzipped")
    for name, one in sizes["files"].items():
        console.print(f"  {name}: {one['bytes'] / 1e3:.0f} kB, gzipped {one['gzipped_bytes'] / 1e3:.0f} kB")
