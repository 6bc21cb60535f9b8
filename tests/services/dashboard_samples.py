"""The dashboard for tests: node, render server and web process of the demo, and a real browser that looks at them."""

import base64
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import trimesh
from jaxtyping import UInt8
from numpy.typing import ArrayLike
from playwright.sync_api import (
    Browser,
    BrowserContext,
    ConsoleMessage,
    Locator,
    Page,
    expect,
    sync_playwright,
)

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.source import open_source
from deltalight.services import ports
from deltalight.services.api.static_page import DASHBOARD
from deltalight.services.demo import NAME, demo_plan, demo_scene
from deltalight.services.host_store import activate_document
from deltalight.services.session_file import session_file
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import Supervisor
from tests.services.live_samples import live_socket, read_frame, wait_for_frames
from tests.services.record_samples import slow_demo

PATIENCE_S = 90.0
# Between pictures of a stand-in: a browser takes longer to draw one than the stand-in to send it.
STAND_IN_PERIOD_S = 0.1
# Where this names a folder, the tests leave pictures of what they see there, in the camera's size.
SCREENSHOTS = os.environ.get("DELTALIGHT_SCREENSHOTS")
SIZE = {"width": 1280, "height": 800}
AXE = DASHBOARD.parent / "node_modules" / "axe-core" / "axe.min.js"  # comes with the dashboard's tools
GRIP_AT = 0.4  # where the gizmo's arrow is taken, in its own lengths
GIZMO_SIZE = 1.35  # as the page sets it
BOX_TOP_M = np.array([-0.06, 0.18, 0.134])  # of the green box, on the cardboard one
JPEG_QUALITY = 75  # keeps most below 100 kB


# The first has no windows, which take half of the processor time.
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, BROWSERS)), None)
USES_BROWSER = pytest.mark.skipif(
    CHROMIUM is None or not (DASHBOARD / "index.html").is_file(),
    reason="no Chromium is installed, or the dashboard is not built; `./run test --all` sees to both",
)
NEEDS_BROWSER = [pytest.mark.slow(seconds=6), USES_BROWSER]


@contextmanager
def chromium() -> Iterator[Browser]:
    """A running browser; `expect` waits for it as long as everything else does.

    It keeps no process in reserve for the next page, which would take a third of a second of the processor each time.
    """
    expect.set_options(timeout=PATIENCE_S * 1000)
    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--renderer-process-limit=1"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield browser
        browser.close()


@dataclass(frozen=True)
class Stack:
    """A running demo: `address` is host:port, `client` speaks with /api/v1, `path` is the active scene's."""

    address: str
    client: httpx.Client
    path: str

    def scene(self) -> dict[str, Any]:
        """The active scene, as its route answers."""
        answer = self.client.get(self.path)
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    def document(self) -> dict[str, Any]:
        found: dict[str, Any] = self.scene()["document"]
        return found

    def object(self, name: str) -> dict[str, Any]:
        """One object of the scene's document."""
        found: dict[str, Any] = next(each for each in self.document()["objects"] if each["id"] == name)
        return found

    def get(self, path: str) -> Any:  # noqa: ANN401 - JSON
        answer = self.client.get(path)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def recorded_at_s(self, recording: str, folder: Path) -> list[float]:
        """When the frames of a recording were captured; it is downloaded into the folder."""
        file = folder / "downloaded.mcap"
        file.write_bytes(self.client.get(f"/recordings/{recording}/content").raise_for_status().content)
        return [time_ns / 1e9 for time_ns in open_source(file).timestamps_ns]

    def header(self) -> dict[str, Any]:
        """What the newest picture says of itself."""
        with live_socket(self.address) as socket:
            return read_frame(socket, PATIENCE_S)


@contextmanager
def demo_stack(data: Path) -> Iterator[Stack]:
    """The demo with small pictures, so that a software renderer makes several a second."""
    source = slow_demo(data, (640, 480)) if SCREENSHOTS else slow_demo(data)
    with running_stack(data, _scene(), source) as stack:
        yield stack


@contextmanager
def running_stack(data: Path, scene: SceneDocument, source: Path) -> Iterator[Stack]:
    """Node, render server and web process over a recording or a data set."""
    (port,) = ports.private_ports(1)
    with Store(data) as store:
        shown = activate_document(store, scene)
    with session_file(shown) as session:
        plan = replace(demo_plan(session), source=str(source), data=data, page_port=port)
        with Supervisor(plan.specs()) as supervisor, _kept_alive(supervisor):
            address = f"{ports.LOOPBACK}:{port}"
            wait_for_frames(address, PATIENCE_S)
            with httpx.Client(base_url=f"http://{address}/api/v1", timeout=PATIENCE_S) as client:
                yield Stack(address, client, f"/scenes/{client.get('/active-scene').json()['id']}")


def _scene() -> SceneDocument:
    small = {"volume_size": 32, "rsm_size": 256, "cone_count": 6, "triangle_budget": 8000, "bounces": 0}
    plain = {"caustics": False, "screen_space": False, "mirrored_lights": False, "far_volume": False}
    output = {"antialiasing": True} if SCREENSHOTS else {"width": 320, "height": 240}
    return demo_scene("dvct").replaced(name=NAME, method={"name": "dvct", **small, **plain}, output=output)


@contextmanager
def _kept_alive(supervisor: Supervisor) -> Iterator[None]:
    ended = threading.Event()
    thread = threading.Thread(target=supervisor.run, args=(ended.is_set,))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def shows_passes_with(name: str, stack: Stack, page: "Desk") -> bool:
    """Whether the largest passes are shown of a picture that has this one, too small to be among them or not."""
    header = stack.header()
    shown = set(page.page.locator(".legend tbody th").all_inner_texts()) - {"others"}
    current = {*header["pass_times_ms"], *header["reused_pass_times_ms"]}
    return name in current and bool(shown) and shown <= current


def complaints_of(page: Page, *, expected: Sequence[str] = ()) -> list[str]:
    """What the browser will complain of from now on: faults of the page, and errors in its console.

    Every test of the dashboard asserts that the list is empty at its end. `expected` are parts of those that the test
    brings about itself, such as "status of 401".
    """
    complaints: list[str] = []

    def hear(text: str) -> None:
        if not any(part in text for part in expected):
            complaints.append(text)

    def hear_console(message: ConsoleMessage) -> None:
        if message.type == "error":
            hear(f"{message.text} ({message.location['url']})")

    page.on("pageerror", lambda fault: hear(str(fault)))
    page.on("console", hear_console)
    return complaints


class Desk:
    """A page of the dashboard as a person uses it, beside the REST API of the same stack."""

    def __init__(self, stack: Stack, page: Page) -> None:
        self.stack = stack
        self.page = page
        self.complaints = complaints_of(page)
        page.set_default_timeout(PATIENCE_S * 1000)

    def open(self) -> None:
        """Loads the page and waits until it shows a picture of the newest revision."""
        self.page.goto(f"http://{self.stack.address}/")
        self.shows_newest()

    def named(self, role: str, name: str) -> Locator:
        return self.page.get_by_role(role, name=name, exact=True)  # type: ignore[arg-type]

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Waits for something; `what` says for what if it never comes."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > deadline_s:
                pytest.fail(f"it never came: {what}")
            self.page.wait_for_timeout(50)

    def shows_newest(self) -> None:
        """Waits until the page shows a picture of the scene as REST has it; changes may be on their way there."""
        shown = self.page.locator(".status-strip dl div", has_text="Revision").locator("dd")
        self.until(
            lambda: shown.count() and shown.inner_text() == str(self.stack.scene()["revision"]),
            "a picture of the newest revision",
        )

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The picture as the page shows it, BGR."""
        url = self.named("img", "Live picture").evaluate("canvas => canvas.toDataURL()")
        png = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        picture = cv2.imdecode(png, cv2.IMREAD_COLOR)
        assert picture is not None
        return np.asarray(picture, np.uint8)

    def place_of(self, point_m: ArrayLike) -> tuple[float, float]:
        """Where on the screen the newest picture shows a point of the world, CSS pixels."""
        header = self.stack.header()
        camera = CameraModel.from_dict(header["camera"])
        seen_m = np.linalg.inv(header["world_from_camera"]) @ [*np.asarray(point_m, float), 1.0]
        column, row = camera.project(seen_m[None, :3])[0]
        box = self.page.locator("#stage").bounding_box()
        assert box is not None
        factor = box["width"] / camera.width
        return box["x"] + (column + 0.5) * factor, box["y"] + (row + 0.5) * factor

    def pixel_at(self, place: tuple[float, float]) -> dict[str, float]:
        """The picture's pixel at a place on the screen, as `POST /live/pick` wants it."""
        box = self.page.locator("#stage").bounding_box()
        assert box is not None
        factor = self.stack.header()["camera"]["width"] / box["width"]
        return {"x": (place[0] - box["x"]) * factor - 0.5, "y": (place[1] - box["y"]) * factor - 0.5}

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.page.mouse.move(*start)
        self.page.mouse.down()
        self.page.mouse.move((start[0] + end[0]) / 2, (start[1] + end[1]) / 2, steps=4)
        self.page.mouse.move(*end, steps=4)
        self.page.mouse.up()

    def swipe(self, start: tuple[float, float], end: tuple[float, float], steps: int = 5) -> None:
        """Drag with a finger."""
        places = np.linspace(start, end, steps + 1)
        devtools = self.page.context.new_cdp_session(self.page)
        for kind, (x, y) in zip(["touchStart", *["touchMove"] * steps], places, strict=True):
            devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y}]})
        devtools.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        devtools.detach()

    def faults_for_screen_readers(self) -> list[str]:
        """What axe finds in the page as it is: rule, elements, and why."""
        self.page.evaluate(AXE.read_text())
        found = self.page.evaluate("async () => (await axe.run({ resultTypes: ['violations'] })).violations")
        return [
            f"{rule['id']}: {node['target']} {node['failureSummary']}"
            for rule in found
            for node in rule["nodes"]
        ]

    def beyond_the_edge(self) -> list[str]:
        """What does not fit: controls that the window cuts off, a page that scrolls sideways, figures over panels."""
        outside: list[str] = self.page.evaluate(
            """() => [...document.querySelectorAll(":is(.top, .stage-bar, .drawer-bar) :is(button, label, select)")]
                .filter((each) => { const { left, right } = each.getBoundingClientRect();
                    return right > innerWidth || left < 0; })
                .map((each) => each.ariaLabel ?? each.title)"""
        )
        if self.page.evaluate("document.documentElement.scrollWidth > innerWidth"):
            outside.append("the page")
        if self.page.evaluate(
            """() => { const strip = document.querySelector(".status-strip");
                return getComputedStyle(strip).overflowX === "visible" && strip.scrollWidth > strip.clientWidth; }"""
        ):
            outside.append("the figures below the picture")
        return outside

    def drop(self, name: str, content: bytes, place: tuple[float, float]) -> None:
        """Drops a file on the picture."""
        sent = {"name": name, "content": base64.b64encode(content).decode()}
        transfer = self.page.evaluate_handle(
            """({ name, content }) => {
                const bytes = Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0));
                const transfer = new DataTransfer();
                transfer.items.add(new File([bytes], name));
                return transfer;
            }""",
            sent,
        )
        event = {"dataTransfer": transfer, "clientX": place[0], "clientY": place[1]}
        for kind in ("dragover", "drop"):
            self.page.dispatch_event("#stage", kind, event)

    def photograph(self, name: str) -> None:
        """Keeps a picture of the page where pictures are wanted."""
        photograph(self.page, name)


def photograph(page: Page, name: str) -> None:
    """Keeps a picture of a page where pictures are wanted."""
    if SCREENSHOTS:
        path = Path(SCREENSHOTS) / f"dashboard_{name}.jpg"
        page.screenshot(path=path, type="jpeg", quality=JPEG_QUALITY)


@contextmanager
def desk(stack: Stack, context: BrowserContext) -> Iterator[Desk]:
    """A new page; what the browser complained of fails the test at its end."""
    seat = Desk(stack, context.new_page())
    try:
        seat.open()
        yield seat
        assert seat.complaints == [], seat.complaints
    finally:
        seat.page.close()


def knot_m(stack: Stack) -> np.ndarray:
    return np.array(stack.object("knot")["pose"]["translation_m"])


def shows_knot(picture: np.ndarray) -> np.ndarray:
    """Where the knot's blue-green is, which nothing else in the room has."""
    hue, saturation, _ = cv2.split(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV))
    is_knot = np.asarray((hue > 75) & (hue < 95) & (saturation > 110))
    assert is_knot.sum() > 100
    return is_knot


def green_centre(picture: np.ndarray) -> np.ndarray:
    """Mean column and row of the knot."""
    rows, columns = np.nonzero(shows_knot(picture))
    return np.array([columns.mean(), rows.mean()])


def recorded_s(stack: Stack) -> float:
    return max((each["duration_s"] or 0 for each in stack.get("/recordings")), default=0)


def steep_place(page: Desk, stack: Stack) -> tuple[float, float]:
    """A place on the screen where the picture shows something real that stands upright."""
    box = page.page.locator("#stage").bounding_box()
    assert box is not None
    for row, column in np.ndindex(9, 16):
        place = (box["x"] + box["width"] * (column + 0.5) / 16, box["y"] + box["height"] * (row + 0.5) / 9)
        seen = stack.client.post("/live/pick", json=page.pixel_at(place)).json()
        if seen["kind"] == "real" and seen["normal"] and abs(seen["normal"][2]) < 0.3:
            return place
    pytest.fail("the picture shows nothing steep")


def magenta(picture: np.ndarray) -> int:
    blue, green, red = (channel.astype(int) for channel in cv2.split(picture))
    return int(((red > 1.6 * green) & (blue > 1.4 * green)).sum())


def box_glb(edge: float = 0.12) -> bytes:
    """A magenta box, 12 cm where its file is in metres; the room does not have its colour."""
    box = trimesh.creation.box((edge, edge, edge))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 200, 255], metallicFactor=0.0)
    box.visual = trimesh.visual.TextureVisuals(material=material)
    content: bytes = box.export(file_type="glb")
    return content


@contextmanager
def fresh_desk(
    stack: Stack,
    browser: Browser,
    document: dict[str, object],
    **context: Any,  # noqa: ANN401
) -> Iterator[Desk]:
    """The page of somebody who comes for the first time, in a browser of its own, with a scene as it begins."""
    stack.client.put(stack.path, json=document).raise_for_status()
    with browser.new_context(**context) as opened, desk(stack, opened) as seat:
        yield seat


def arrow_place(page: Desk, from_m: np.ndarray) -> tuple[tuple[float, float], float]:
    """Where the gizmo's x arrow is on the screen, and how far from its origin that is in metres.

    three's TransformControls keep their size on the screen: see `factor` in its source.
    """
    header = page.stack.header()
    eye_m = np.array(header["world_from_camera"])[:3, 3]
    camera = CameraModel.from_dict(header["camera"])
    half_angle_tangent = camera.height / 2 / camera.matrix[1, 1]
    length_m = np.linalg.norm(from_m - eye_m) * 1.9 * half_angle_tangent * GIZMO_SIZE / 4
    reach_m = float(GRIP_AT * length_m)
    return page.place_of(from_m + np.array([reach_m, 0, 0])), reach_m


def seen_m(stack: Stack, page: Desk, point_m: np.ndarray) -> np.ndarray:
    """The surface that the renderer finds where a point is seen."""
    found: dict[str, Any] = {}

    def answers() -> bool:  # not while a busy machine's renderer takes its time
        answer = stack.client.post("/live/pick", json=page.pixel_at(page.place_of(point_m)))
        found.update(answer.json())
        return answer.status_code == 200

    page.until(answers, "what is seen there")
    assert found["kind"] == "real"
    return np.array(found["point_m"])


def is_on_box(page: Desk, stack: Stack) -> bool:
    """Drag on to where the box is now (the recorded camera swings)."""
    page.page.mouse.move(*page.place_of(BOX_TOP_M), steps=3)
    return bool(abs(knot_m(stack)[2] - BOX_TOP_M[2]) < 0.015)
