"""What the dashboard says of slow frames, of what is missing and while it connects, and how it fits a phone.

Node and renderer are stand-ins.
"""

import re
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import cv2
import pytest
from playwright.sync_api import Browser, Route, WebSocketRoute, expect

from deltalight import __version__
from deltalight.protocol.source import open_source
from deltalight.sensor_node.cameras.playback import PlaybackCamera
from deltalight.services import ports
from deltalight.services.demo import POSTER, POSTER_BEFORE
from deltalight.services.node_process import playback_control
from tests.services.dashboard_samples import (
    NEEDS_BROWSER,
    SCREENSHOTS,
    SIZE,
    STAND_IN_PERIOD_S,
    Desk,
    Stack,
)
from tests.services.live_samples import AGE_S, NOISE, LiveApi, live_api, shade
from tests.services.record_samples import frames, write

pytestmark = NEEDS_BROWSER
LAMP = {"type": "sphere", "position_m": [1, 0, 1], "intensity": 5}
SCENE = {"name": "Gallery", "lights": {"mode": "manual", "manual": [LAMP]}}
PHONE = {"width": 390, "height": 844}
TABS = ("Performance", "Nodes", "Recordings", "Snapshots", "Compare", "History")
PANELS = ("Object", "Lights", "Real", "Method", "Output")


def stand_in(data: Path, **settings: object) -> AbstractContextManager[LiveApi]:
    """An API whose pictures are noise, or the demo's still where pictures are wanted."""
    picture = cv2.cvtColor(cv2.imread(str(POSTER)), cv2.COLOR_BGR2RGB) if SCREENSHOTS else NOISE
    return live_api(data, period_s=STAND_IN_PERIOD_S, picture=picture, **settings)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveApi]:
    with stand_in(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture
def stack(live: LiveApi) -> Stack:
    """A scene of its own for each test; the stand-in claims to show its first revision."""
    store = live.api.store
    scene = store.scenes.activate(store.scenes.create(SCENE).head.id)
    live.stream.scene, live.stream.is_busy, live.stream.camera_fps = (scene.head.id, 1), False, 15.0
    live.stream.ages_s = (AGE_S,)
    return Stack(live.address, live.client, f"/scenes/{scene.head.id}")


def seat(stack: Stack, browser: Browser, **options: object) -> Iterator[Desk]:
    with browser.new_context(color_scheme="dark", **options) as context:  # type: ignore[arg-type]
        desk = Desk(stack, context.new_page())
        yield desk
        assert desk.complaints == []


@pytest.fixture
def page(stack: Stack, browser: Browser) -> Iterator[Desk]:
    yield from seat(stack, browser, viewport=SIZE)


@pytest.fixture
def phone(stack: Stack, browser: Browser) -> Iterator[Desk]:
    yield from seat(stack, browser, viewport=PHONE, has_touch=True, is_mobile=True)


def says(page: Desk, word: str) -> None:
    """Waits until the top bar tells that of the picture."""
    expect(page.page.locator(".live-state [role=status]")).to_have_text(word)


def test_a_slow_frame_is_told_as_work_and_not_as_a_fault(live: LiveApi, stack: Stack, page: Desk) -> None:
    page.open()
    says(page, "Live")
    live.stream.is_busy = True
    stack.client.patch(f"{stack.path}/output", json={"antialiasing": True}).raise_for_status()
    banner = page.page.locator(".picture-banner")
    expect(banner).to_have_text(re.compile(r"Rendering your change… [2-9] s"))
    says(page, "Rendering")
    expect(page.page.locator(".picture.not-live")).to_have_count(0)
    page.photograph("rendering")
    live.stream.scene, live.stream.is_busy = (stack.path.rpartition("/")[2], 2), False
    says(page, "Live")
    expect(banner).to_have_count(0)
    live.stream.is_busy = True
    expect(banner).to_have_text(re.compile(r"Waiting for the next frame… \d+ s"))
    live.stream.is_busy = False
    says(page, "Live")


NO_H264 = "delete globalThis.VideoDecoder"  # pictures come as JPEG
SLOW_DECODER = """
    const decode = window.createImageBitmap;
    window.createImageBitmap = async (...picture) => {
        await new Promise((resolve) => setTimeout(resolve, 300));
        return decode(...picture);
    };
"""


def test_the_delay_is_from_the_capture_to_the_page(live: LiveApi, page: Desk) -> None:
    live.stream.ages_s = (60.0, *[10.0] * 6)
    page.page.add_init_script(NO_H264)
    page.page.add_init_script(SLOW_DECODER)
    page.open()
    page.named("tab", "Performance").click()
    strip = page.page.locator(".status-strip dl div", has_text="Delay")
    median_s, p95_s = 0.0, 0.0

    def shows_both() -> bool:
        nonlocal median_s, p95_s
        found = re.fullmatch(r"([\d.]+) s \(p95 ([\d.]+) s\)", strip.locator("dd").inner_text())
        median_s, p95_s = map(float, found.groups()) if found else (0.0, 0.0)
        return median_s < 60 <= p95_s

    page.until(shows_both, "the median and the oldest")
    assert median_s >= 10.3, "with the time that the page took"
    assert p95_s >= 60.3
    assert "capture" in (strip.get_attribute("title") or "")
    assert page.page.evaluate(
        """() => document.querySelector(".status-strip dl").innerText.replace(/\\s+/g, " ").includes(
            document.querySelectorAll(".performance figcaption")[1].innerText.replace(/\\s+/g, " "))"""
    ), "the panel and the strip say the same"


def test_frames_that_stay_away_are_told_with_where_to_look(live: LiveApi, page: Desk) -> None:
    page.open()
    live.stream.is_busy, live.stream.camera_fps = True, 0.0
    says(page, "No new frames")
    expect(page.page.locator(".picture-banner")).to_contain_text("Nodes, below")
    expect(page.page.locator(".picture.not-live")).to_have_count(1)


def test_fisheye_light_cannot_be_chosen_without_a_fisheye_camera(stack: Stack, page: Desk) -> None:
    page.open()
    page.named("tab", "Lights").click()
    expect(page.named("radio", "Fish-eye")).to_be_disabled()
    expect(page.named("radio", "Manual")).to_be_enabled()
    expect(page.page.get_by_text("none is sending")).to_be_visible()
    page.photograph("no_fisheye")
    stack.client.patch(f"{stack.path}/lights", json={"mode": "fisheye"}).raise_for_status()
    expect(page.page.locator(".picture-banner")).to_contain_text("lit by a fish-eye camera")


def test_a_page_that_meets_a_service_of_another_version_is_loaded_anew(page: Desk) -> None:
    connections: list[WebSocketRoute] = []
    heard: list[str] = []

    def pass_on(ours: WebSocketRoute) -> None:
        theirs = ours.connect_to_server()
        connections.append(ours)
        newer = "9.9.9" if len(connections) > 1 else __version__

        def tell(text: str | bytes) -> None:
            ours.send(str(text).replace(__version__, newer))
            heard.append(str(text))

        theirs.on_message(tell)

    page.page.route_web_socket("**/api/v1/events", pass_on)
    page.open()
    page.until(lambda: any(__version__ in text for text in heard), "what says the version")
    with page.page.expect_event("load"):
        connections[0].close()
    page.shows_newest()


def test_nothing_false_is_said_while_the_page_connects(stack: Stack, page: Desk) -> None:
    answered: list[Route] = []

    def hold(route: Route) -> None:
        answered.append(route)

    page.page.route("**/api/v1/active-scene", hold)
    page.page.goto(f"http://{stack.address}/")
    page.until(lambda: answered, "the question for the scene")
    expect(page.page.locator(".skeleton").first).to_be_visible()
    page.photograph("connecting")
    shown = page.page.locator("body").inner_text()
    for false in ("None yet", "No scene", "No lights", "Given model", "No object", "Voxel cone", "view only"):
        assert false not in shown, false
    for route in answered:
        route.continue_()
    page.page.unroute("**/api/v1/active-scene")
    page.shows_newest()
    expect(page.page.locator(".skeleton")).to_have_count(0)
    expect(page.named("treeitem", "Lamp 1")).to_be_visible()


HELD_DECODER = """
    const decode = window.createImageBitmap;
    const released = new Promise((resolve) => (window.release = resolve));
    window.createImageBitmap = async (...picture) => {
        await released;
        return decode(...picture);
    };
"""


@pytest.mark.skipif(not POSTER.is_file(), reason="the demo's files are not in this checkout")
def test_a_still_is_shown_until_the_first_live_picture(live: LiveApi, stack: Stack, page: Desk) -> None:
    still = page.named("img", "Still picture")
    page.page.add_init_script(NO_H264)
    page.page.add_init_script(HELD_DECODER)
    shutil.copyfile(POSTER, live.api.store.poster)
    shutil.copyfile(POSTER_BEFORE, live.api.store.poster_before)
    try:
        page.page.goto(f"http://{stack.address}/")
        page.until(lambda: still.count() and still.evaluate("each => each.naturalWidth"), "the still")
    finally:
        live.api.store.poster.unlink()
        live.api.store.poster_before.unlink()
    assert still.bounding_box() == page.page.locator(".picture").bounding_box(), "it fills the picture"
    expect(page.page.locator(".picture-banner")).to_contain_text("This is a still")
    before = page.named("img", "The camera's picture")
    page.until(lambda: before.evaluate("each => each.naturalWidth"), "what was before")
    covers = "each => getComputedStyle(each).clipPath"
    first = before.evaluate(covers)
    page.until(lambda: before.evaluate(covers) != first, "the split moves")
    page.photograph("poster")
    page.page.evaluate("release()")
    page.shows_newest()
    expect(still).to_have_count(0)
    expect(page.page.locator(".picture-banner")).to_have_count(0)


def test_a_view_is_neither_in_the_scene_nor_in_its_history(live: LiveApi, stack: Stack, page: Desk) -> None:
    page.open()
    view = page.page.get_by_role("toolbar").get_by_label("View")
    view.select_option("delta")
    page.until(lambda: live.server.session.watched == ("delta",), "the view")
    page.until(lambda: abs(page.pixels().mean() - shade("delta")) < 2, "its picture")
    page.page.keyboard.press("Escape")
    page.page.locator("#stage").press("2")
    page.until(lambda: live.server.session.watched == ("effects",), "the view of a key")
    expect(view).to_have_value("effects")
    expect(page.named("button", "Undo")).to_be_disabled()
    assert (stack.scene()["revision"], stack.document()["output"]["view"]) == (1, "composite")
    stack.client.patch(f"{stack.path}/output", json={"view": "volume"}).raise_for_status()
    expect(view).to_have_value("volume")


def test_the_guide_ticks_off_what_was_tried_and_keeps_it(stack: Stack, page: Desk) -> None:
    page.open()
    steps = page.named("region", "Try this").get_by_role("listitem")
    done = page.page.locator(".guide li.done")
    expect(steps).to_have_count(4)
    expect(done).to_have_count(0)
    page.named("button", "Add light").click()
    page.page.get_by_role("menuitem", name="Spot").click()
    expect(done).to_have_count(1)
    expect(done.first).to_contain_text("Change the light")
    page.photograph("guide")
    page.page.reload()
    expect(done).to_have_count(1)
    assert stack.document()["lights"]["manual"][-1]["type"] == "spot"


@contextmanager
def node_that_plays(folder: Path) -> Iterator[tuple[PlaybackCamera, LiveApi]]:
    """A node whose source is a recording, paused at its start, and an API that is told where it is controlled."""
    (port,) = ports.private_ports(1)
    recording = open_source(write(folder / "a.mcap", frames(9)))
    camera = PlaybackCamera(recording, loop=True, playing=False, stays=True)
    endpoint = ports.endpoint(port)
    with playback_control(camera, endpoint, None), stand_in(folder / "data", playback=endpoint) as api:
        yield camera, api


def test_the_camera_of_a_recording_that_the_node_plays_is_moved_by_a_slider(
    browser: Browser, tmp_path: Path
) -> None:
    with ExitStack() as opened:
        camera, api = opened.enter_context(node_that_plays(tmp_path))
        store = api.api.store
        scene = store.scenes.activate(store.scenes.create(SCENE).head.id).head.id
        api.stream.scene = (scene, 1)
        stack = Stack(api.address, api.client, f"/scenes/{scene}")
        page = opened.enter_context(contextmanager(seat)(stack, browser, viewport=SIZE))
        page.open()
        bar = page.named("group", "Camera motion")
        slider, end_s = bar.get_by_role("slider", name="Position"), camera.playback.duration_s
        expect(slider).to_have_value("0")
        expect(page.named("button", "Back to live")).to_have_count(0)
        says(page, "Live")
        step = page.named("region", "Try this").get_by_role("listitem").filter(has_text="Move the camera")
        expect(step).not_to_have_class("done")
        slider.press("End")
        page.until(lambda: camera.playback.position_s == pytest.approx(end_s), "the end")
        expect(step).to_have_class("done")
        bar.get_by_role("button", name="Play", exact=True).click()
        page.until(lambda: camera.playback.playing, "the motion")
        bar.get_by_role("button", name="Pause").click()
        page.until(lambda: not camera.playback.playing, "the pause")
        page.photograph("camera_motion")
        camera.seek(end_s / 2)  # as by another page
        place_s = camera.playback.position_s
        page.until(
            lambda: float(slider.input_value()) == pytest.approx(place_s), "where another page moved it"
        )
        page.page.set_viewport_size(PHONE)  # type: ignore[arg-type]
        assert page.beyond_the_edge() == []
        expect(slider).to_be_in_viewport(ratio=1)


def test_a_name_is_kept_as_it_is_typed_while_the_scene_changes(stack: Stack, page: Desk) -> None:
    page.open()
    page.named("button", "Scenes: Gallery").click()
    page.page.get_by_role("menuitem", name="Rename this scene").click()
    name = page.named("textbox", "Name")
    name.fill("mY room #2")
    stack.client.patch(f"{stack.path}/output", json={"antialiasing": True}).raise_for_status()
    page.until(lambda: page.page.get_by_text("output: antialiasing").count() == 0, "the event")
    expect(name).to_have_value("mY room #2")
    name.press("Enter")
    expect(page.named("button", "Scenes: mY room #2")).to_be_visible()
    page.until(lambda: stack.document()["name"] == "mY room #2", "the name in the document")


def test_everything_can_be_reached_on_a_phone(phone: Desk) -> None:
    phone.open()
    phone.photograph("phone")
    assert phone.beyond_the_edge() == []
    picture = phone.page.locator(".picture").bounding_box()
    assert picture is not None
    assert picture["width"] > 0.8 * PHONE["width"], "the picture is as wide as the phone"
    for panel in PANELS:
        phone.named("tab", panel).tap()
        assert phone.beyond_the_edge() == [], panel
    phone.photograph("phone_output")
    for tab in TABS:
        phone.named("tab", tab).tap()
        expect(phone.page.locator(".drawer-body")).to_be_visible()
        assert phone.beyond_the_edge() == [], tab
        phone.photograph(f"phone_{tab.lower()}")
    phone.named("button", "Close the drawer").tap()
    phone.named("button", "Add object").tap()
    assert phone.beyond_the_edge() == [], "the menu"
    phone.page.keyboard.press("Escape")
    phone.named("button", "Scene and assets").tap()
    phone.named("treeitem", "Lamp 1").tap()
    phone.photograph("phone_tree")
    phone.named("button", "Scene and assets").tap()
    phone.named("spinbutton", "Intensity").wait_for()
    assert phone.beyond_the_edge() == []
    phone.photograph("phone_lamp")
