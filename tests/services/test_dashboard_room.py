"""The dashboard in a real browser: what the picture does not show, lamps beside it."""

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser

from deltalight.protocol.camera_model import CameraModel
from deltalight.services.demo import RECORDING, SCENE
from tests.services.dashboard_samples import NEEDS_BROWSER, SIZE, Desk, Stack, demo_stack, fresh_desk

pytestmark = [
    *NEEDS_BROWSER,
    pytest.mark.skipif(
        not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
    ),
]
SIGN_MARGIN_PX = 18.0  # as the page keeps signs from the picture's border
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
