"""The dashboard where a token is needed: who may look, who may change. Node and renderer are stand-ins."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.services.dashboard_samples import (
    AXE,
    NEEDS_BROWSER,
    PATIENCE_S,
    SIZE,
    STAND_IN_PERIOD_S,
    complaints_of,
    photograph,
)
from tests.services.live_samples import LiveApi, live_api

pytestmark = NEEDS_BROWSER
SCENE = {
    "name": "Gallery",
    "lights": {"mode": "manual", "manual": [{"type": "sphere", "position_m": [1, 0, 1], "intensity": 5}]},
}
INSPECTOR = ("Object", "Lights", "Real", "Method", "Output")
DRAWER = ("Performance", "Nodes", "Recordings", "Snapshots", "Compare", "History")
# What somebody who may only look can use: it changes this browser's page, and nothing of the service.
LOOKING = {
    *INSPECTOR,
    *DRAWER,
    *(
        "Scene and assets",
        "Inspector",
        "Scenes: Gallery",
        "Keyboard shortcuts",
        "Light appearance",
        "Room in 3-D",
        "Sign out",
    ),
    *("Outlines and lights", "Close the drawer", "Lamp 1"),
    *(
        "View",
        "Picture",
        "Effects",
        "Change of light",
        "Volume",
        "Light's view",
        "Error of the paper",
        "Camera",
    ),
}


@pytest.fixture
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveApi]:
    """With the rules of an address that leaves the host (the test itself listens on loopback)."""
    with live_api(tmp_path_factory.mktemp("data"), period_s=STAND_IN_PERIOD_S, host="0.0.0.0") as running:
        store = running.api.store
        store.scenes.activate(store.scenes.create(SCENE).head.id)
        yield running


@pytest.fixture
def page(guarded: LiveApi, browser: Browser) -> Iterator[Page]:
    with browser.new_context(viewport=SIZE, color_scheme="dark") as context:  # type: ignore[arg-type]
        page = context.new_page()
        complaints = complaints_of(page, expected=("status of 401",))
        page.set_default_timeout(PATIENCE_S * 1000)
        page.goto(f"http://{guarded.address}/")
        yield page
        assert complaints == []


def sign_in(page: Page, token: str) -> None:
    page.get_by_label("Token").fill(token)
    page.get_by_role("button", name="Sign in").click()


def button(page: Page, name: str) -> Locator:
    return page.get_by_role("button", name=name, exact=True)


def test_a_wrong_token_is_told_and_a_right_one_is_kept_by_the_tab(guarded: LiveApi, page: Page) -> None:
    sign_in(page, "guess")
    expect(page.get_by_role("alert")).to_contain_text("is unknown")
    photograph(page, "sign_in")
    sign_in(page, guarded.api.store.tokens.create("desk", "control"))
    expect(page.get_by_role("status").filter(has_text="Live")).to_be_visible()
    page.reload()
    expect(page.get_by_role("status").filter(has_text="Live")).to_be_visible()
    button(page, "Add light").click()
    page.get_by_role("menuitem", name="Ambient light").click()
    expect(page.get_by_role("treeitem", name="Ambient light 2")).to_be_visible()
    guarded.api.store.tokens.revoke("desk")
    expect(page.get_by_role("alert")).to_contain_text("is unknown")
    expect(page.get_by_label("Token")).to_be_focused()


def test_who_may_only_look_finds_nothing_to_change(guarded: LiveApi, page: Page) -> None:
    sign_in(page, guarded.api.store.tokens.create("wall", "view"))
    expect(page.get_by_text("view only", exact=True)).to_be_visible()
    expect(page.get_by_role("status").filter(has_text="Live")).to_be_visible()
    page.get_by_role("treeitem", name="Lamp 1").click()
    found: set[str] = set()
    for tab in (*DRAWER, *INSPECTOR):
        page.get_by_role("tab", name=tab, exact=True).click()
        found |= usable(page)
    photograph(page, "view_only")
    assert found - LOOKING == set()
    button(page, "Scenes: Gallery").click()
    enabled = page.locator("[role=menuitem]:enabled").all_inner_texts()
    assert enabled == ["Export as JSON"]
    page.keyboard.press("Escape")
    page.locator("#stage").focus()
    for key in ("Delete", "ArrowUp", "2", "Control+z"):
        page.keyboard.press(key)
    button(page, "Sign out").click()
    expect(page.get_by_label("Token")).to_be_visible()
    assert page.get_by_role("alert").count() == 0, "nothing was refused, since nothing was tried"


def usable(page: Page) -> set[str]:
    """Names of the controls that can be used."""
    names: list[str] = page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, a[download]")]
            .filter((each) => !each.disabled && !each.hidden && !each.matches(".info"))
            .map((each) => each.ariaLabel ?? (each.closest("label") ?? each).textContent.trim())"""
    )
    return set(names)


@pytest.mark.skipif(
    not AXE.is_file(), reason="axe is not installed; `npm ci` in services/dashboard does that"
)
def test_axe_finds_no_fault_in_the_sign_in_page(page: Page) -> None:
    page.get_by_label("Token").wait_for()
    page.evaluate(AXE.read_text())
    assert page.evaluate("async () => (await axe.run()).violations.map((each) => each.help)") == []


def test_the_reference_of_the_api_comes_from_the_service_alone(guarded: LiveApi, page: Page) -> None:
    fetched: list[str] = []
    page.on("request", lambda request: fetched.append(request.url))
    page.goto(f"http://{guarded.address}/docs")
    page.locator(".opblock-summary").first.click()
    expect(page.get_by_text("List all scenes.")).to_be_visible()
    assert all(url.startswith((f"http://{guarded.address}/", "data:")) for url in fetched), fetched
    assert any(url.endswith("/openapi.json") for url in fetched)
