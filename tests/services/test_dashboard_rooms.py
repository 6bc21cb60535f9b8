"""The dashboard's list of rooms in a real browser: live pictures, why a room waits, and moving one by hand."""

import re
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from deltalight.services import ports
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper
from tests.services.api_samples import RunningApi, running_api
from tests.services.dashboard_samples import NEEDS_BROWSER, SCREENSHOTS, SIZE
from tests.services.live_samples import StandInStream
from tests.services.room_samples import StandInPlacer, plans, running

pytestmark = NEEDS_BROWSER
PERIOD_S = 0.2


@pytest.fixture
def api(tmp_path: Path) -> Iterator[RunningApi]:
    """Three rooms, two of which have a slot and show pictures; the third waits."""
    placer = StandInPlacer(slot_names=("slot-1", "slot-2", "slot-3"), answers=True)
    keeper = RoomKeeper(plans(tmp_path, "hall", "door", "attic"), placer)
    directory = ports.endpoint(ports.private_ports(1)[0])
    with ExitStack() as stack:
        stack.enter_context(closing(DirectoryServer(directory, keeper)))
        stack.enter_context(closing(placer))
        running(keeper, placer, "hall", "door")
        keeper.drain("attic")
        for room in ("hall", "door"):
            port = int(placer.of(room).publish.rpartition(":")[2])
            stack.enter_context(closing(StandInStream(port, PERIOD_S)))
        yield stack.enter_context(running_api(tmp_path / "data", rooms=directory))


@pytest.fixture
def page(api: RunningApi, browser: Browser) -> Iterator[Page]:
    context = browser.new_context(viewport=SIZE, color_scheme="dark")  # type: ignore[arg-type]
    page = context.new_page()
    page.goto(f"http://127.0.0.1:{api.client.base_url.port}/")
    yield page
    context.close()


def photograph(page: Page, name: str) -> None:
    if SCREENSHOTS:
        page.screenshot(path=Path(SCREENSHOTS) / f"{name}.png")


def test_rooms_are_chosen_by_their_pictures_and_drained_by_hand(page: Page, api: RunningApi) -> None:
    rooms = page.get_by_role("dialog", name="Rooms")
    expect(rooms.get_by_role("article")).to_have_count(3)
    for title in ("The hall", "The door"):
        picture = rooms.get_by_role("article", name=title).locator("img")
        expect(picture).to_have_js_property("complete", True)
        assert picture.evaluate("each => each.naturalWidth") > 0
    waits = rooms.get_by_role("article", name="The attic")
    expect(waits).to_contain_text("waiting")
    expect(waits).to_contain_text("It was drained")
    photograph(page, "rooms")
    door = rooms.get_by_role("article", name="The door")
    door.get_by_role("button", name="Where The door runs").click()
    expect(door.get_by_role("menuitem", name="Move to slot-3")).to_be_visible()
    photograph(page, "rooms_menu")
    door.get_by_role("menuitem", name="Move to slot-3").click()
    expect(door).to_contain_text("moving to slot-3")
    assert api.client.get("/rooms/door").json()["moving_to"] == "slot-3"
    rooms.get_by_role("button", name="Open The door").click()
    page.wait_for_url(re.compile("room=door"))
    expect(page.get_by_role("banner")).to_contain_text("The door")
    expect(page.get_by_role("dialog", name="Rooms")).to_have_count(0)
    photograph(page, "room_door")
    expected = api.client.get("/rooms/door/active-scene").json()["document"]["name"]
    expect(page.get_by_role("banner")).to_contain_text(expected)
    api.client.post("/rooms/door/drain").raise_for_status()
    page.get_by_role("banner").get_by_title("All rooms").click()
    expect(page.get_by_role("article", name="The door")).to_contain_text("It was drained")
    host = page.get_by_role("list", name="Hosts").get_by_role("listitem").filter(has_text="slot-1")
    expect(host).to_contain_text("1 of 1 slots in use")
    host.get_by_role("button", name="Drain").click()
    expect(host).to_contain_text("drained")
    photograph(page, "rooms_hosts")
    assert [each["drained"] for each in api.client.get("/hosts").json()] == [True, False, False]
    host.get_by_role("button", name="Accept rooms").click()
    expect(host.get_by_role("button", name="Drain")).to_be_visible()


def test_a_single_room_has_no_list(tmp_path: Path, browser: Browser) -> None:
    with running_api(tmp_path) as api:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{api.client.base_url.port}/")
        expect(page.get_by_role("banner")).to_be_visible()
        expect(page.get_by_role("button", name="Record")).to_be_visible()
        assert page.get_by_title("All rooms").count() == 0
        page.close()
