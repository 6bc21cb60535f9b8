"""The fish-eye panel with a real picture: data set, node, render server, web process, browser."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from deltalight.protocol.scene import load_scene
from tests.sensor_node.fisheye_samples import equidistant
from tests.services.dashboard_samples import NEEDS_BROWSER, SIZE, Desk, desk, running_stack
from tests.services.test_light_chain import LAMP, write_scene, write_take

pytestmark = NEEDS_BROWSER


@pytest.fixture
def page(tmp_path: Path, browser: Browser) -> Iterator[Desk]:
    """The dashboard over a take whose bracket shows an even room with one lamp."""
    write_take(tmp_path / "take")
    scene = load_scene(write_scene(tmp_path))
    with (
        running_stack(tmp_path / "data", scene, tmp_path / "take") as stack,
        browser.new_context(viewport=SIZE, color_scheme="dark") as context,  # type: ignore[arg-type]
        desk(stack, context) as seat,
    ):
        yield seat


def test_the_lamp_is_marked_where_the_fisheye_picture_shows_it(page: Desk) -> None:
    page.named("tab", "Nodes").click()
    page.named("img", "1 light").wait_for()
    picture = page.named("img", "Fish-eye picture")
    page.until(lambda: picture.evaluate("image => image.complete && image.naturalWidth > 0"), "the picture")
    page.photograph("fisheye_lamp")
    seen = page.stack.get("/fisheye")
    lens = equidistant(160)
    place = lens.project(LAMP[None])[0] * seen["width"] / lens.width
    mark = page.page.locator(".fisheye-picture circle")
    marked = [float(mark.get_attribute(key) or "nan") for key in ("cx", "cy")]
    assert marked == pytest.approx(list(place), abs=2), "a pixel of this picture is more than a degree"
    brightest = picture.evaluate(BRIGHTEST)
    share = np.array(marked) / [seen["width"], seen["height"]]
    assert list(brightest) == pytest.approx(list(share), abs=0.03), "the picture shows the lamp there"


# Where the picture is brightest, as shares of its width and height: the middle of its whitest pixels.
BRIGHTEST = """image => {
    const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    const light = Array.from({ length: data.length / 4 }, (_, index) => data[4 * index + 1]);
    const most = light.reduce((high, each) => Math.max(high, each), 0);
    const at = [...light.keys()].filter((index) => light[index] > 0.95 * most);
    const mean = (of) => at.reduce((sum, index) => sum + of(index), 0) / at.length;
    const [column, row] = [mean((index) => index % canvas.width), mean((index) => Math.floor(index / canvas.width))];
    return [column / canvas.width, row / canvas.height];
}"""
