"""The dashboard in a real browser, beside REST: what is done in the page is in the scene, and in the picture."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from playwright.sync_api import Browser, Route

from deltalight.services.demo import RECORDING, SCENE
from deltalight.services.recording_copies import export_recording
from tests.services.dashboard_samples import (
    AXE,
    BOX_TOP_M,
    NEEDS_BROWSER,
    SIZE,
    Desk,
    Stack,
    arrow_place,
    box_glb,
    demo_stack,
    fresh_desk,
    green_centre,
    is_on_box,
    knot_m,
    magenta,
    recorded_s,
    seen_m,
    shows_knot,
    shows_passes_with,
    steep_place,
)
from tests.services.record_samples import frames, write

pytestmark = [
    *NEEDS_BROWSER,
    pytest.mark.skipif(
        not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
    ),
]
FREE_TABLE_M = (0.05, 0.25, 0.0)  # between the board and the boxes, where nothing stands
BALL_TOP_M = np.array([0.316, -0.178, 0.064])  # of the yellow ball
BESIDE_GIZMO_M = np.array([-0.05, 0.0, 0.1])  # on the knot, from its origin


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


def test_the_first_start_shows_a_working_scene_and_what_to_try(page: Desk) -> None:
    picture = page.pixels()
    assert picture.std() > 20, "the picture is not empty"
    assert page.page.get_by_role("status").filter(has_text="Live").count() == 1
    assert page.named("treeitem", "knot").count() == 1
    guide = page.named("region", "Try this")
    guide.get_by_role("button", name="Drag the object").click()
    assert page.named("treeitem", "knot").get_attribute("aria-selected") == "true"
    page.photograph("first_start")
    page.named("button", "Close Try this").click()
    page.page.reload()
    page.shows_newest()
    assert guide.count() == 0, "what was dismissed stays away"


def test_a_glb_that_is_dropped_stands_where_it_was_let_go(stack: Stack, page: Desk) -> None:
    assert magenta(page.pixels()) < 20
    place = page.place_of(FREE_TABLE_M)
    seen = stack.client.post("/live/pick", json=page.pixel_at(place)).json()
    assert seen["kind"] == "real"
    page.drop("crate.glb", box_glb(), place)
    page.named("treeitem", "crate").wait_for()
    page.until(
        lambda: page.named("treeitem", "crate").get_attribute("aria-selected") == "true", "its selection"
    )
    crate = stack.object("crate")
    stands_m = np.array(crate["pose"]["translation_m"]) - [0, 0, 0.06]
    assert np.linalg.norm(stands_m[:2] - FREE_TABLE_M[:2]) < 0.03, "the point under the pointer"
    assert abs(stands_m[2]) < 0.02, "it stands on the table"
    assert any(crate["asset"] == each["asset"] for each in stack.get("/assets"))
    page.shows_newest()
    page.until(lambda: magenta(page.pixels()) > 100, "the box in the picture")
    page.photograph("drop")


def test_an_object_that_is_added_finds_room_beside_the_first(stack: Stack, page: Desk) -> None:
    for name in ("crate", "crate 2"):
        page.named("button", "Add object").click()
        if name == "crate":
            with page.page.expect_file_chooser() as chosen:
                page.page.get_by_role("menuitem", name="From a file").click()
            chosen.value.set_files({"name": "crate.glb", "mimeType": "", "buffer": box_glb()})
        else:
            page.named("menuitem", "crate.glb").click()
        page.named("treeitem", name).wait_for()
    places = [np.array(stack.object(name)["pose"]["translation_m"]) for name in ("knot", "crate", "crate 2")]
    for index, place in enumerate(places[1:], 1):
        assert stack.object(f"crate{' 2' * (index - 1)}")["pose"]["rotation_wxyz"] == [1, 0, 0, 0], "upright"
        assert -0.02 < place[2] - 0.06 < 0.2, "on the table or on a thing that stands on it"
        assert all(np.linalg.norm((place - other)[:2]) > 0.12 for other in places[:index]), (
            "beside the others"
        )
    page.named("tab", "History").click()
    assert page.page.get_by_role("listitem").filter(has_text="crate 2 added").count() == 1
    page.shows_newest()
    page.photograph("added")


def test_a_simple_object_is_taken_from_the_shelf(stack: Stack, page: Desk) -> None:
    page.named("button", "Add object").click()
    page.named("menuitem", "Chrome ball").click()
    page.named("treeitem", "Chrome ball").wait_for()
    ball, names = stack.object("Chrome ball"), {each["asset"]: each["names"] for each in stack.get("/assets")}
    assert names[ball["asset"]] == ["Chrome ball.glb"]
    page.named("button", "Add Chrome ball.glb").wait_for()
    page.named("button", "Add object").click()
    assert page.named("menuitem", "Chrome ball.glb").count() == 0, "it is in the menu once"


def test_a_copy_finds_room_beside_the_original(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    page.named("button", "Duplicate").click()
    page.until(
        lambda: page.named("treeitem", "knot 2").get_attribute("aria-selected") == "true", "the copy selected"
    )
    original, copy = stack.object("knot"), stack.object("knot 2")
    way_m = np.subtract(copy["pose"]["translation_m"], original["pose"]["translation_m"])
    assert np.linalg.norm(way_m[:2]) > 0.1, "beside the original"
    assert abs(way_m[2]) < 0.2, "on the table or on a thing that stands on it"
    assert len({(each["asset"], *each["pose"]["rotation_wxyz"]) for each in (original, copy)}) == 1, "alike"


def test_nothing_is_placed_on_a_wall(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    before = stack.object("knot")["pose"]
    page.page.locator("#stage").focus()
    page.page.keyboard.press("p")
    page.page.mouse.click(*steep_place(page, stack))
    page.page.get_by_text("too steep to stand on").wait_for()
    assert stack.object("knot")["pose"] == before
    page.page.mouse.click(*page.place_of(FREE_TABLE_M))
    page.until(lambda: stack.object("knot")["pose"] != before, "the knot where the next click was")
    pose = stack.object("knot")["pose"]
    assert np.linalg.norm(np.subtract(pose["translation_m"], FREE_TABLE_M)[:2]) < 0.06
    assert pose["rotation_wxyz"] == before["rotation_wxyz"]


def test_an_override_of_the_material_begins_with_the_files_own(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    page.named("switch", "Override material").click()
    page.named("slider", "Roughness, slider").wait_for()
    page.named("spinbutton", "Emission red").wait_for()
    page.until(lambda: stack.object("knot")["material"], "the material")
    red, green, _ = stack.object("knot")["material"]["base_color"]
    assert green > 2 * red, "the file's own green"
    page.photograph("material")
    page.named("switch", "Override material").click()
    page.until(lambda: stack.object("knot")["material"] is None, "the file's material")


def test_a_fault_of_one_panel_leaves_the_others(page: Desk) -> None:
    def spoil(route: Route) -> None:
        answer = route.fetch()
        scene = answer.json()
        scene["document"]["objects"][0]["material"] = {"base_color": [1, 1, 1]}
        route.fulfill(response=answer, json=scene)

    page.page.route("**/active-scene", spoil)
    page.page.reload()
    page.named("treeitem", "knot").click()
    page.page.get_by_role("alert").filter(has_text="The inspector failed").wait_for()
    assert page.complaints != [], "the fixture hears of it"
    page.complaints.clear()
    page.named("tab", "Lights").click()
    page.named("button", "Add light").first.wait_for()
    assert page.complaints == []


def test_the_gizmo_moves_an_object_along_its_axis(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    before_m, centre = knot_m(stack), green_centre(page.pixels())
    start, reach_m = arrow_place(page, before_m)
    end = page.place_of(before_m + np.array([reach_m - 0.12, 0, 0]))
    page.drag(start, end)
    page.until(lambda: knot_m(stack)[0] < before_m[0] - 0.05, "the knot at another place")
    page.shows_newest()
    after_m = knot_m(stack)
    assert after_m[0] == pytest.approx(before_m[0] - 0.12, abs=0.03)
    assert list(after_m[1:]) == pytest.approx(list(before_m[1:]), abs=1e-4), "the arrow holds the other axes"
    assert page.named("spinbutton", "Position x").input_value() == f"{after_m[0]:.4f}".rstrip("0")
    moved_px = green_centre(page.pixels()) - centre
    assert np.linalg.norm(moved_px) > 0.03 * page.pixels().shape[1], "the picture follows"
    page.photograph("gizmo")
    page.page.keyboard.press("Control+z")
    page.until(lambda: np.array_equal(knot_m(stack), before_m), "one undo takes the whole drag back")


def test_what_is_dragged_stands_on_what_the_camera_sees(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    before = stack.object("knot")["pose"]
    page.page.mouse.move(*page.place_of(before["translation_m"]))  # the gizmo's middle, and the knot's foot
    page.page.mouse.down()
    page.until(lambda: is_on_box(page, stack), "the knot on the box")
    page.shows_newest()
    page.photograph("surfaces")
    page.page.mouse.up()
    page.shows_newest()
    pose = stack.object("knot")["pose"]
    assert pose["translation_m"][2] == pytest.approx(BOX_TOP_M[2], abs=0.015)
    assert np.linalg.norm(knot_m(stack)[:2] - BOX_TOP_M[:2]) < 0.04
    assert pose["rotation_wxyz"] == before["rotation_wxyz"], "upright"
    page.page.keyboard.press("Control+z")
    page.until(lambda: stack.object("knot")["pose"] == before, "one undo takes the whole drag back")


def test_without_surfaces_what_is_dragged_keeps_its_height(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    toggle = page.named("button", "Stand on surfaces")
    assert toggle.get_attribute("aria-pressed") == "true", "as people expect"
    page.page.locator("#stage").focus()
    page.page.keyboard.press("f")
    assert toggle.get_attribute("aria-pressed") == "false"
    before_m = knot_m(stack)
    page.drag(page.place_of(before_m + BESIDE_GIZMO_M), page.place_of(BOX_TOP_M))
    page.until(lambda: knot_m(stack)[1] > before_m[1] + 0.05, "the knot farther away")
    page.shows_newest()
    assert knot_m(stack)[2] == before_m[2]
    assert page.named("switch", "Lean with surfaces").is_disabled(), "it would mean nothing"


def test_a_lamp_changes_the_light_on_the_object(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "Lamp 1").click()
    bright = page.pixels()
    intensity = page.named("spinbutton", "Intensity")
    assert float(intensity.input_value()) == stack.document()["lights"]["manual"][0]["intensity"]
    page.photograph("light")
    intensity.fill("0.5")
    intensity.press("Enter")
    page.until(
        lambda: stack.document()["lights"]["manual"][0]["intensity"] == 0.5, "the light's new strength"
    )
    page.shows_newest()
    dim = page.pixels()
    assert dim[shows_knot(dim)].mean() < 0.9 * bright[shows_knot(bright)].mean()
    assert page.named("slider", "Intensity, slider").input_value() == "0.5"


def test_a_lamp_follows_its_shadow(stack: Stack, page: Desk) -> None:
    def lamp_m() -> np.ndarray:
        return np.array(stack.document()["lights"]["manual"][0]["position_m"])

    before_m, on_knot_m = lamp_m(), np.add(knot_m(stack), [0, 0, 0.1])
    shadow_m = before_m + (on_knot_m - before_m) * before_m[2] / (before_m - on_knot_m)[2]
    page.drag(page.place_of(shadow_m), page.place_of(np.add(shadow_m, [0, 0.15, 0])))
    page.until(lambda: lamp_m()[1] < before_m[1] - 0.3, "the lamp, which goes the other way")
    page.until(
        lambda: page.named("treeitem", "Lamp 1").get_attribute("aria-selected") == "true", "its selection"
    )
    reach_m = [np.linalg.norm(each - on_knot_m) for each in (before_m, lamp_m())]
    assert reach_m[0] == pytest.approx(reach_m[1], abs=0.15), "as far from the knot as before"
    assert lamp_m()[2] > 0.2, "above the table"
    page.page.keyboard.press("Control+z")
    page.until(lambda: np.array_equal(lamp_m(), before_m), "one undo takes the whole drag back")


def test_another_method_renders_the_next_picture(stack: Stack, page: Desk) -> None:
    page.named("tab", "Performance").click()
    page.until(lambda: shows_passes_with("light real voxels", stack, page), "the passes of cone tracing")
    page.photograph("performance")
    page.page.get_by_role("toolbar").get_by_label("Method").select_option("dlpv")
    page.until(lambda: stack.document()["method"]["name"] == "dlpv", "the method")
    page.shows_newest()
    page.until(lambda: shows_passes_with("propagate rho", stack, page), "the passes of light propagation")
    of_before = page.page.locator(".legend tbody tr", has_text="light real voxels").locator("td")
    assert of_before.all_inner_texts() in ([], ["–"]), "passes that do not run have no times"


def test_a_light_is_added_along_a_shadow(stack: Stack, page: Desk) -> None:
    lamp = stack.document()["lights"]["manual"][0]
    top_m, lamp_m = seen_m(stack, page, BALL_TOP_M), np.array(lamp["position_m"])
    tip_m = lamp_m + (top_m - lamp_m) * lamp_m[2] / (lamp_m - top_m)[2]
    page.named("button", "Add light").first.click()
    page.named("menuitem", "From a shadow…").click()
    page.page.mouse.click(*page.place_of(tip_m))
    page.page.get_by_text("Now click the point").wait_for()
    page.photograph("shadow_light")
    page.page.mouse.click(*page.place_of(top_m))
    page.named("treeitem", "Sun 3").wait_for()
    light, way_m = stack.document()["lights"]["manual"][-1], tip_m - lamp_m
    assert np.degrees(np.arccos(np.dot(light["direction"], way_m / np.linalg.norm(way_m)))) < 6
    share = light["irradiance"] * np.dot(way_m, way_m) / lamp["intensity"]
    assert 0.3 < share < 2, "the table is darker than what is assumed"


def test_before_and_after_are_saved_as_a_moving_picture(page: Desk) -> None:
    with page.page.expect_download() as saved:
        page.named("button", "Save before and after as GIF").click()
    assert saved.value.suggested_filename.startswith("before-after-")
    shown = [
        np.asarray(each.convert("RGB")) for each in ImageSequence.Iterator(Image.open(saved.value.path()))
    ]
    greens = [int((each[..., 1] > each[..., 0].astype(int) + 60).sum()) for each in shown]
    assert max(greens) > 5 * min(greens) + 50, "the knot comes and goes"


def test_two_methods_are_compared_on_one_frame(stack: Stack, page: Desk) -> None:
    page.named("tab", "Compare").click()
    page.named("combobox", "Right (B)").select_option("dvct")
    page.named("button", "Compare this frame").click()
    split = page.page.get_by_role("slider", name="Split between")
    split.wait_for(state="attached")
    sides = page.page.locator(".compare img")
    loaded = "images => images.length === 2 && images.every((each) => each.complete && each.naturalWidth > 0)"
    page.until(lambda: sides.evaluate_all(loaded), "both pictures")
    (taken, *_) = stack.get("/snapshots")
    assert [each["name"] for each in taken["pictures"]] == ["a", "b"]
    assert page.page.get_by_text(f"Frame {taken['frame_id']}").count() >= 1
    split.focus()
    split.press("ArrowRight")
    assert float(split.input_value()) > 50
    page.photograph("compare")
    page.named("button", "Back to the live picture").click()
    assert sides.count() == 0


def test_undo_and_redo_by_keys_and_buttons(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    before_m = knot_m(stack)
    page.page.locator("#stage").focus()
    for _ in range(3):
        page.page.keyboard.press("PageUp")
    page.until(lambda: knot_m(stack)[2] > before_m[2] + 0.029, "three steps up")
    raised_m = knot_m(stack)
    page.named("button", "Undo").click()
    page.until(lambda: np.array_equal(knot_m(stack), before_m), "steps in a row undone as one")
    page.page.keyboard.press("Control+Shift+z")
    page.until(lambda: np.array_equal(knot_m(stack), raised_m), "the change made again")
    page.named("tab", "History").click()
    page.page.get_by_role("listitem").filter(has_text="shown").wait_for()
    page.photograph("history")
    page.page.keyboard.press("Delete")
    page.named("treeitem", "knot").wait_for(state="detached")
    page.until(lambda: stack.document()["objects"] == [], "the document without the knot")
    page.page.keyboard.press("Control+z")
    page.named("treeitem", "knot").wait_for()
    assert list(knot_m(stack)) == list(raised_m)


def test_three_seconds_are_recorded_and_replayed(stack: Stack, page: Desk, tmp_path: Path) -> None:
    page.named("button", "Record").click()
    page.until(lambda: recorded_s(stack) >= 3, "three seconds")
    page.photograph("record")
    page.named("button", "Stop recording").click()
    card = page.page.locator("article.take")
    card.get_by_role("button", name="Replay").click()
    page.named("group", "Replay").wait_for()
    (take,) = stack.get("/recordings")
    assert take["state"] == "finished"
    assert take["duration_s"] >= 2.5
    assert stack.get("/replay")["recording"] == take["id"]
    page.page.get_by_role("status").filter(has_text="Replay").wait_for()
    page.named("button", "Pause").click()
    page.named("button", "Play").wait_for()
    position, middle_s = page.named("slider", "Position"), take["duration_s"] / 2
    position.press("End")  # a busy machine records few frames, and the place is that of a frame
    page.until(lambda: stack.get("/replay")["position_s"] > middle_s, "the end of the recording")
    position.press("Home")
    page.until(lambda: stack.get("/replay")["position_s"] < middle_s, "its start")
    before_s = stack.get("/replay")["position_s"]
    position.press("ArrowRight")
    page.until(lambda: stack.get("/replay")["position_s"] > before_s, "the next frame")
    now, (first_s, second_s, *_) = stack.get("/replay"), stack.recorded_at_s(take["id"], tmp_path)
    assert now["position_s"] - before_s == pytest.approx(second_s - first_s, abs=1e-6)
    assert now["playing"] is False
    page.shows_newest()
    page.photograph("replay")
    page.named("button", "Back to live").click()
    page.named("group", "Replay").wait_for(state="detached")
    page.until(lambda: stack.get("/replay")["recording"] is None, "live again")


def test_a_zipped_folder_that_is_dropped_is_opened_with_a_checklist(
    stack: Stack, page: Desk, tmp_path: Path
) -> None:
    take = write(tmp_path / "desk.mcap", frames(3))
    export_recording(take, tmp_path / "desk", lambda numbers: numbers)
    content = Path(shutil.make_archive(str(tmp_path / "desk"), "zip", tmp_path, "desk")).read_bytes()
    page.drop("desk.zip", content, page.place_of(FREE_TABLE_M))
    card = page.named("article", "desk")
    card.wait_for()
    needs = card.get_by_role("list", name="What relighting needs").get_by_role("listitem")
    assert needs.all_inner_texts() == [
        "Depth in 3 of 3 frames.",
        "Poses are given.",
        "No fish-eye camera: place lamps by hand.",
    ]
    page.until(lambda: stack.get("/replay")["recording"] == "desk", "its replay")
    assert stack.get("/replay")["playing"] is False, "it waits at its first frame"
    page.photograph("open_recording")
    page.named("button", "Back to live").click()
    page.until(lambda: stack.get("/replay")["recording"] is None, "live again")
    stack.client.delete("/recordings/desk").raise_for_status()


def test_a_reload_finds_everything_as_it_was(stack: Stack, page: Desk) -> None:
    page.named("treeitem", "knot").click()
    scale = page.named("spinbutton", "Scale")
    scale.fill("0.5")
    scale.press("Enter")
    page.until(lambda: stack.object("knot")["pose"]["scale"] == 0.5, "the scale")
    page.named("button", "Light appearance").click()
    page.named("tab", "Nodes").click()
    page.page.reload()
    page.shows_newest()
    assert page.page.locator("html").get_attribute("data-theme") == "light"
    assert page.named("tab", "Nodes").get_attribute("aria-selected") == "true"
    page.page.get_by_role("article", name="render-server").wait_for()
    page.named("treeitem", "knot").click()
    assert page.named("spinbutton", "Scale").input_value() == "0.5"
    page.photograph("light_appearance")
    page.named("button", "Undo").click()
    page.until(
        lambda: stack.object("knot")["pose"]["scale"] == 1, "a change from before the reload taken back"
    )


def test_everything_fits(page: Desk) -> None:
    page.named("tab", "Method").click()
    for width, height in ((1280, 800), (1024, 768), (768, 1024), (768, 740)):
        page.page.set_viewport_size({"width": width, "height": height})
        page.photograph(f"{width}x{height}")
        assert page.beyond_the_edge() == [], f"{width} x {height}"


@pytest.mark.skipif(
    not AXE.is_file(), reason="axe is not installed; `npm ci` in services/dashboard does that"
)
def test_axe_finds_no_fault(page: Desk) -> None:
    tabs = [page.named("tab", tab) for tab in ("Performance", "Nodes", "History")]
    knot, lamp = page.named("treeitem", "knot"), page.named("treeitem", "Lamp 1")
    faults = page.faults_for_screen_readers()
    for shown in (knot, *tabs, lamp, page.named("button", "Scenes: Demo")):
        shown.click()
        faults += page.faults_for_screen_readers()
    page.page.keyboard.press("Escape")
    page.named("button", "Light appearance").click()
    faults += page.faults_for_screen_readers()
    for shown in (knot, *tabs, lamp, page.named("button", "Scenes: Demo")):
        shown.click()
        faults += page.faults_for_screen_readers()
    assert faults == []


@pytest.fixture
def tablet(stack: Stack, browser: Browser, first_document: dict[str, object]) -> Iterator[Desk]:
    """A tablet held across: fingers in place of a mouse."""
    held = {"viewport": {"width": 1024, "height": 768}, "has_touch": True, "is_mobile": True}
    with fresh_desk(stack, browser, first_document, **held) as seat:
        yield seat


def test_fingers_select_and_move_and_reach_every_panel(stack: Stack, tablet: Desk) -> None:
    before_m = knot_m(stack)
    tablet.page.touchscreen.tap(*tablet.place_of(before_m + BESIDE_GIZMO_M))
    tablet.named("textbox", "Name").wait_for()
    tablet.photograph("tablet")
    at = tablet.place_of(before_m + BESIDE_GIZMO_M)
    tablet.swipe(at, (at[0] - 80, at[1] + 20))
    tablet.until(
        lambda: np.linalg.norm(knot_m(stack) - before_m) > 0.05, "the knot where the finger let it go"
    )
    tablet.shows_newest()
    assert abs(knot_m(stack)[2]) < 0.02, "on the table"
    assert tablet.beyond_the_edge() == []
    tablet.named("button", "Scene and assets").tap()
    tablet.named("treeitem", "Lamp 1").tap()
    tablet.named("spinbutton", "Intensity").wait_for()
    tablet.named("button", "Scene and assets").tap()
    tablet.named("tab", "Compare").tap()
    tablet.named("button", "Compare this frame").wait_for()
    tablet.photograph("tablet_panels")
    tablet.named("button", "Close the drawer").tap()
    for width, height in ((768, 1024), (1280, 800)):
        tablet.page.set_viewport_size({"width": width, "height": height})
        assert tablet.beyond_the_edge() == []
