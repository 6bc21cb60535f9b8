"""The dashboard's files: headers, caches, nothing else of the disk."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest

from tests.services.api_samples import running_api, sentence


def build(place: Path) -> Path:
    """A build of the dashboard below a folder, and a file beside it that is nobody's business."""
    (place / "secret.txt").write_text("not for you")
    dist = place / "dist"
    (dist / "assets").mkdir(parents=True)
    (dist / "index.html").write_text("<!doctype html><title>Deltalight</title>")
    (dist / "assets" / "index-1a2b3c.js").write_text("1")
    return dist


@contextmanager
def serving(folder: Path) -> Iterator[httpx.Client]:
    """A client of the root of a service that serves `folder`."""
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setattr("deltalight.services.api.static_page.DASHBOARD", folder)
        port = stack.enter_context(running_api(folder.parent / "data")).client.base_url.port
        yield stack.enter_context(httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def page(folder: Path) -> Iterator[httpx.Client]:
    with serving(folder) as client:
        yield client


def test_the_page_is_locked_down_and_never_stale(page: httpx.Client) -> None:
    answer = page.get("/")
    assert answer.status_code == 200
    assert "<title>Deltalight</title>" in answer.text
    policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert policy["img-src"] == "'self' blob: data:"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-cache"
    assert page.get("/", headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_hashed_files_are_kept_for_long_and_missing_ones_are_not(page: httpx.Client) -> None:
    script = page.get("/assets/index-1a2b3c.js")
    assert script.headers["cache-control"] == "public, max-age=31536000, immutable"
    assert script.headers["content-type"].startswith("text/javascript")
    assert script.headers["x-content-type-options"] == "nosniff"
    missing = page.get("/assets/index-000.js")
    assert missing.status_code == 404
    assert "immutable" not in missing.headers.get("cache-control", "")


def test_addresses_of_the_api_are_not_files(page: httpx.Client, folder: Path) -> None:
    (folder / "api").mkdir()
    (folder / "api" / "file").touch()
    sentence(page.get("/api/file"), 404)


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.txt",
        "/..%2fsecret.txt",
        "/%2e%2e/secret.txt",
        "/assets/..%2f..%2fsecret.txt",
        "//etc/passwd",
        "/%2fetc/passwd",
        "/..%5csecret.txt",
        "/index.html%00.js",
        "/" + "a" * 5000,
    ],
)
def test_no_address_leaves_the_folder(page: httpx.Client, path: str) -> None:
    sentence(page.get(page.base_url.copy_with(raw_path=path.encode())), 404)


def test_links_that_lead_out_of_the_folder_are_not_followed(page: httpx.Client, folder: Path) -> None:
    (folder / "link.txt").symlink_to(folder.parent / "secret.txt")
    sentence(page.get("/link.txt"), 404)
    assert "Deltalight" in page.get("/").text
    assert sentence(page.post("/"), 405)


def test_without_a_build_the_page_says_how_to_make_one(tmp_path: Path) -> None:
    folder = build(tmp_path)
    (folder / "index.html").unlink()
    with serving(folder) as page:
        answer = page.get("/")
    assert answer.status_code == 503
    assert "./run demo" in answer.text
    assert "content-security-policy" in answer.headers
