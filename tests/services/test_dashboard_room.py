"""The dashboard in a real browser: the room in 3-D, lamps beside the picture, models of the shelf and of files."""

import gzip
import os
import signal
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image
from playwright.sync_api import Browser, Route, expect

from deltalight.protocol.camera_model import CameraModel
from deltalight.services.api.static_page import DASHBOARD
from deltalight.services.demo import RECORDING, SCENE
from tests.services.dashboard_samples import (
    NEEDS_BROWSER,
    SIZE,
    Desk,
    Stack,
    box_glb,
    demo_stack,
    fresh_desk,
    recorded_s,
)

pytestmark = [
    *NEEDS_BROWSER,
    pytest.mark.skipif(
        not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
    ),
]
SIGN_MARGIN_PX = 18.0  # as the page keeps signs from the picture's border
MOST_BYTES = 400_000  # of the first page, compressed
BESIDE_M = [1.2, -0.1, 1.0]  # in the camera's axes: the picture ends nearer to its middle


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with demo_stack(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture(scope="module")
def first_document(stack: Stack) -> dict[str, object]:
    return {key: value for key, value in stack.document().items() if key != "revision"}


@pytest.fixture
def page(stack: Stack, browser: Browser, first_document: dict[str, object]) -> Iterator[Desk]:
    """The page of somebody who comes for the first time, and the demo's scene as it begins."""
    with fresh_desk(stack, browser, first_document, viewport=SIZE, color_scheme="dark") as seat:
        yield seat


def lamp_m(stack: Stack) -> np.ndarray:
    return np.array(stack.document()["lights"]["manual"][0]["position_m"])


def test_a_lamp_out_of_sight_is_dragged_by_its_sign_at_the_border(stack: Stack, page: Desk) -> None:
    world_from_camera = np.array(stack.header()["world_from_camera"])
    before_m = world_from_camera[:3, :3] @ BESIDE_M + world_from_camera[:3, 3]
    change = {"position_m": before_m.tolist()}
    stack.client.patch(f"{stack.path}/lights/manual/0", json=change).raise_for_status()
    page.shows_newest()
    box = page.page.locator("#stage").bounding_box()
    assert box is not None
    corner, size = np.array([box["x"], box["y"]]), np.array([box["width"], box["height"]])
    place = np.array(page.place_of(before_m))
    sign = np.clip(place, corner + SIGN_MARGIN_PX, corner + size - SIGN_MARGIN_PX)
    assert np.linalg.norm(sign - place) > 50, "the picture does not show the lamp"
    page.drag((sign[0], sign[1]), (sign[0] - 150, sign[1]))
    page.until(
        lambda: page.named("treeitem", "Lamp 1").get_attribute("aria-selected") == "true", "its selection"
    )
    page.shows_newest()
    page.photograph("border_lamp")
    way_m, camera = lamp_m(stack) - before_m, CameraModel.from_dict(stack.header()["camera"])
    tangent = 150 / box["width"] * camera.width / camera.matrix[0, 0]
    distance_m = np.linalg.norm(before_m - world_from_camera[:3, 3])
    assert abs(way_m[2]) < 1e-5, "it keeps its height"
    assert np.linalg.norm(way_m) == pytest.approx(tangent * distance_m, rel=0.15), "the camera swings"
    assert np.dot(way_m, world_from_camera[:3, 0]) < -0.9 * np.linalg.norm(way_m), "to the left"
    page.page.keyboard.press("Control+z")
    page.until(lambda: np.array_equal(lamp_m(stack), before_m), "one undo takes the whole drag back")


def test_the_models_of_the_shelf_are_added_and_the_figure_walks(stack: Stack, page: Desk) -> None:
    for name in ("Walking figure", "Glowing lantern", "Helmet"):
        page.named("button", "Add object").click()
        page.named("menuitem", name).click()
        page.named("treeitem", name).wait_for()
    figure = stack.object("Walking figure")
    assert figure["animation"]["clip"] == "round"
    assert figure["rigid"] is False
    assert stack.object("Helmet")["animation"] is None
    page.shows_newest()
    page.photograph("shelf")


def loaded_bytes(page: Desk) -> dict[str, int]:
    """What the page has loaded of its own files, compressed."""
    names = page.page.evaluate("performance.getEntriesByType('resource').map((each) => each.name)")
    files = {name.rpartition("/assets/")[2] for name in names if "/assets/" in name and "/api/" not in name}
    return {name: len(gzip.compress((DASHBOARD / "assets" / name).read_bytes())) for name in files}


def test_an_object_in_other_units_is_scaled_and_a_message_says_so(stack: Stack, page: Desk) -> None:
    page.named("button", "Add object").click()
    with page.page.expect_file_chooser() as chosen:
        page.page.get_by_role("menuitem", name="From a file").click()
    chosen.value.set_files({"name": "drawn in mm.glb", "mimeType": "", "buffer": box_glb(edge=120)})
    message = page.page.locator(".toast", has_text="so it was added at scale 0.001.")
    message.wait_for()
    page.photograph("units")
    assert stack.object("drawn in mm")["pose"]["scale"] == 0.001
    message.wait_for(state="detached")


def test_the_first_page_is_light_and_the_room_comes_when_it_is_asked_for(stack: Stack, page: Desk) -> None:
    page.until(lambda: any(name.startswith("gizmo") for name in loaded_bytes(page)), "the gizmo")
    first = loaded_bytes(page)
    assert not any(name.startswith("room") for name in first)
    poster = len(stack.client.get("/poster.jpg").content)
    assert sum(first.values()) + poster + (DASHBOARD / "index.html").stat().st_size <= MOST_BYTES
    page.named("button", "Room in 3-D").click()
    page.until(lambda: any(name.startswith("room") for name in loaded_bytes(page)), "the room's own code")


def seen(page: Desk) -> np.ndarray:
    """What the room in 3-D shows."""
    picture = Image.open(BytesIO(page.page.locator("canvas.room").screenshot()))
    return np.asarray(picture.convert("RGB"), np.float64)


def changes(page: Desk, what: str, act: Callable[[], object]) -> None:
    before = seen(page)
    act()
    page.until(lambda: np.abs(seen(page) - before).mean() > 2, what)


def test_the_room_is_looked_at_from_anywhere(stack: Stack, page: Desk) -> None:
    page.named("button", "Room in 3-D").click()
    canvas = page.page.locator("canvas.room[data-shown=true]")
    canvas.wait_for()
    page.until(lambda: seen(page).std() > 20, "the room")
    green = seen(page)
    assert ((green[..., 1] > 1.5 * green[..., 0]) & (green[..., 1] > 60)).sum() > 200, "the knot"
    page.photograph("room")
    box = canvas.bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    changes(page, "a turn by the mouse", lambda: page.drag(middle, (middle[0] + 120, middle[1] - 40)))
    changes(page, "a zoom by the wheel", lambda: page.page.mouse.wheel(0, -400))
    canvas.focus()
    changes(page, "a turn by a key", lambda: page.page.keyboard.press("ArrowLeft"))
    changes(page, "a zoom by a key", lambda: page.page.keyboard.press("-"))
    changes(page, "the first look", lambda: page.named("button", "Look from the camera").click())
    before = seen(page)
    stack.client.delete(f"{stack.path}/objects/knot").raise_for_status()
    page.until(lambda: np.abs(seen(page) - before).mean() > 0.5, "the room without the knot")
    assert page.faults_for_screen_readers() == []
    page.named("button", "Light appearance").click()
    page.photograph("room_light")
    assert page.faults_for_screen_readers() == []
    page.page.locator("body").press("o")
    page.named("img", "Live picture").wait_for()
    page.shows_newest()


def test_the_room_of_fused_depth_is_shown_too(stack: Stack, page: Desk) -> None:
    """Its surfaces come from all frames so far, and most of them have the newest picture on them."""
    page.named("button", "Room in 3-D").click()
    canvas = page.page.locator("canvas.room[data-shown=true]")
    canvas.wait_for()
    page.until(lambda: seen(page).std() > 20, "the room of the newest depth")
    of_depth, document = seen(page), stack.document()
    page.page.locator("body").press("o")
    stack.client.put(stack.path, json={**document, "real": {"geometry": "fused"}}).raise_for_status()
    page.until(lambda: stack.header()["scene"]["revision"] > document["revision"], "the fused scene")
    page.named("button", "Room in 3-D").click()
    canvas.wait_for()
    page.until(lambda: seen(page).std() > 20, "the fused room")
    page.photograph("room_fused")
    assert np.abs(seen(page) - of_depth).mean() < 25, "the same room from the same place"


def test_a_room_that_is_not_known_yet_says_so(page: Desk) -> None:
    refusal = {"status": 422, "title": "Refused", "type": "urn:deltalight:problem:refused"}
    sentence = "No surface of the room is known yet; ask again when depth shows some."
    page.page.route(
        "**/live/room.glb", lambda route: route.fulfill(status=422, json={**refusal, "detail": sentence})
    )
    page.named("button", "Room in 3-D").click()
    page.page.get_by_role("status").filter(has_text=sentence).wait_for()
    page.page.unroute("**/live/room.glb")
    page.complaints.clear()  # the browser's own line about the refusal
    page.named("button", "Update the room").click()
    page.page.locator("canvas.room[data-shown=true]").wait_for()


def test_fingers_turn_the_room(stack: Stack, browser: Browser, first_document: dict[str, object]) -> None:
    held = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    with fresh_desk(stack, browser, first_document, **held) as phone:
        phone.named("button", "Room in 3-D").tap()
        canvas = phone.page.locator("canvas.room[data-shown=true]")
        canvas.wait_for()
        box = canvas.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        changes(phone, "a turn by a finger", lambda: phone.swipe((x, y), (x + 90, y)))
        assert phone.beyond_the_edge() == []


def test_a_page_that_is_left_open_recovers_when_the_web_process_was_killed(stack: Stack, page: Desk) -> None:
    port = int(stack.address.rpartition(":")[2])
    (web,) = {
        each.pid
        for each in psutil.net_connections("tcp")
        if each.laddr.port == port and each.status == psutil.CONN_LISTEN
    }
    state = page.page.locator(".live-state [role=status]")
    expect(state).to_have_text("Live")
    page.page.wait_for_load_state("networkidle")
    os.kill(web, signal.SIGKILL)
    expect(state).to_have_text("Reconnecting")
    expect(state).to_have_text("Live")
    stack.client.patch(f"{stack.path}/output", json={"view": "delta"}).raise_for_status()
    page.shows_newest()
    refused = (
        "WebSocket connection",
        "ERR_CONNECTION_REFUSED",
        "ERR_CONNECTION_RESET",
    )  # while nobody was there
    page.complaints[:] = [each for each in page.complaints if not any(part in each for part in refused)]


def test_relit_pictures_are_recorded_and_downloaded_as_a_video(stack: Stack, page: Desk) -> None:
    pytest.importorskip("av")
    page.named("tab", "Recordings").click()
    page.named("switch", "Keep relit pictures too").click()
    page.named("button", "Record").click()
    page.until(lambda: recorded_s(stack) >= 1, "a second")
    page.named("button", "Stop recording").click()
    page.page.locator("article.take").get_by_role("button", name="Replay").wait_for()
    (take,) = stack.get("/recordings")
    assert take["composites"] > 0
    page.named("button", f"Actions for {take['id']}").click()
    with page.page.expect_download() as saved:
        page.named("menuitem", "Download .mp4").click()
    assert saved.value.suggested_filename == f"{take['id']}.mp4"
    assert b"ftyp" in Path(saved.value.path()).read_bytes()[:16]
    is_stopped = False

    def answer(route: Route) -> None:
        nonlocal is_stopped
        is_stopped |= route.request.method == "DELETE"
        state = {"state": "absent" if is_stopped else "making", "progress": 0.4, "detail": ""}
        route.fulfill(status=204) if route.request.method == "DELETE" else route.fulfill(json=state)

    page.page.route("**/video", answer)
    page.named("button", f"Actions for {take['id']}").click()
    page.named("menuitem", "Download .mp4").click()
    shown = page.page.get_by_label("Making the video")
    shown.wait_for()
    assert shown.get_attribute("value") == "0.4"
    page.named("button", "Cancel").click()
    shown.wait_for(state="detached")
    assert is_stopped
    stack.client.delete(f"/recordings/{take['id']}").raise_for_status()


def test_before_and_after_of_a_snapshot_are_downloaded_as_a_video(page: Desk) -> None:
    pytest.importorskip("av")
    page.named("tab", "Snapshots").click()
    page.named("button", "Take a snapshot").first.click()
    page.page.get_by_role("button", name="Files of frame").click()
    with page.page.expect_download() as saved:
        page.named("menuitem", "before-after.mp4").click()
    assert saved.value.suggested_filename.endswith("-before-after.mp4")
    assert b"ftyp" in Path(saved.value.path()).read_bytes()[:16]
