"""The dashboard's camera switch in a real browser: what is shown, what its address keeps, and where clicks go."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.services.camera_samples import SHADES, CameraApi, camera_api
from tests.services.dashboard_samples import NEEDS_BROWSER, PATIENCE_S, SCREENSHOTS, SIZE

pytestmark = NEEDS_BROWSER
SHADE_TOLERANCE = 3  # of a video's colours
IS_SHADE = """([shade, tolerance]) => {
  const canvas = document.querySelector("canvas");
  if (!canvas?.width) return false;
  const middle = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data;
  return Math.abs(middle[0] - shade) <= tolerance;
}"""


@pytest.fixture
def api(tmp_path: Path) -> Iterator[CameraApi]:
    with camera_api(tmp_path, period_s=0.2) as running:
        yield running


@pytest.fixture
def page(api: CameraApi, browser: Browser) -> Iterator[Page]:
    expect.set_options(timeout=1e3 * PATIENCE_S)
    context = browser.new_context(viewport=SIZE, color_scheme="dark")  # type: ignore[arg-type]
    context.set_default_timeout(1e3 * PATIENCE_S)
    page = context.new_page()
    page.goto(f"http://{api.address}/")
    yield page
    context.close()
    expect.set_options()


def wait_for_picture(page: Page, camera: str) -> None:
    """Waits until the page shows a camera's picture."""
    page.wait_for_function(IS_SHADE, arg=[SHADES[camera], SHADE_TOLERANCE])


def test_each_page_shows_the_camera_that_was_chosen_there(page: Page, api: CameraApi) -> None:
    switch = page.get_by_role("combobox", name="Camera")
    expect(switch).to_have_value("left")
    wait_for_picture(page, "left")
    switch.select_option("right")
    wait_for_picture(page, "right")
    expect(page).to_have_url(re.compile(r"[?&]camera=right"))
    if SCREENSHOTS:
        page.screenshot(path=Path(SCREENSHOTS) / "camera_switch.png")
    with page.expect_request("**/live/pick") as asked:
        box = page.locator("canvas").first.bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    body = asked.value.post_data_json
    assert body is not None
    assert body["camera"] == "right"
    other = page.context.new_page()
    other.goto(f"http://{api.address}/")
    wait_for_picture(other, "left")
    page.reload()
    wait_for_picture(page, "right")
    expect(switch).to_have_value("right")
    api.room.statuses = {"left": "silent", "right": "live"}
    expect(other.get_by_role("combobox", name="Camera").get_by_role("option")).to_have_text(
        ["left (silent)", "right"]
    )
    wait_for_picture(other, "right")  # the first that sends
    api.room.statuses = {"left": "live"}
    expect(switch).to_have_count(0)
    wait_for_picture(page, "left")
