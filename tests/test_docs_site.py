"""The documentation as a site: it builds without a warning, loads nothing from elsewhere, quotes what is said."""

import ast
import logging
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

import deltalight as dl

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
ROOMS = ("protocol", "sensor_node", "render_server", "services", "deltalight")


def build_site(folder: Path) -> None:
    """Builds it; every broken link or anchor, and every page outside of the navigation, raises."""
    pytest.importorskip("material", reason="mkdocs-material is not installed")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    config = load_config(str(DOCS / "site" / "mkdocs.yml"), site_dir=str(folder), strict=True)
    logging.getLogger("mkdocs").setLevel(logging.WARNING)
    config.plugins.on_startup(command="build", dirty=False)
    build(config)
    config.plugins.on_shutdown()


class Loaded(HTMLParser):
    """Collects what a browser fetches by itself when it opens a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        fetched = values.get("href") if tag == "link" else values.get("src")
        if fetched and values.get("rel") not in ("canonical", "prev", "next"):
            self.addresses.append(fetched)


def check_that_pages_load_nothing_from_other_hosts(site: Path) -> None:
    pages = [*site.rglob("*.html")]
    assert len(pages) > len([*DOCS.glob("*.md")])
    for page in pages:
        parser = Loaded()
        parser.feed(page.read_text(encoding="utf-8"))
        assert parser.addresses
        for address in parser.addresses:
            assert not re.match(r"(https?:)?//", address), f"{page.name} loads {address}"
            if not address.startswith("data:") and page.name != "404.html":
                assert (page.parent / address.partition("?")[0]).exists(), f"{page.name}: {address}"


def check_formulas_notebooks_and_files_outside_of_docs(site: Path) -> None:
    def page(name: str) -> str:
        return (site / f"{name}.html").read_text(encoding="utf-8")

    method = page("method")
    assert method.count("<math") > 200
    assert r"\frac" not in re.sub(r"<pre.*?</pre>", "", method, flags=re.DOTALL)
    assert "RelightingMethod" in page("notebooks/own_method")
    assert "declare" in page("source/render_server/methods/dvct.py")
    assert 'href="source/protocol/SPEC.html' in page("formats")


def check_that_the_reference_has_every_public_name(site: Path) -> None:
    page = (site / "api.html").read_text(encoding="utf-8")
    for name in set(dl.__all__) - {"__version__", "open"} | {"open_take", "render", "forget"}:
        assert re.search(rf'id="deltalight\.[\w.]*\b{name}"', page), name


@pytest.mark.slow
def test_the_site_is_whole_and_needs_no_other_host(tmp_path: Path) -> None:
    build_site(tmp_path)
    check_that_pages_load_nothing_from_other_hosts(tmp_path)
    check_formulas_notebooks_and_files_outside_of_docs(tmp_path)
    check_that_the_reference_has_every_public_name(tmp_path)


def spoken() -> str:
    """All sources, with the parts of each string joined."""
    texts = (path.read_text(encoding="utf-8") for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    return "\n".join(re.sub(r'"\n\s*f?"', "", text) for text in texts)


def literal_end(message: ast.expr) -> str:
    last = message.values[-1] if isinstance(message, ast.JoinedStr) else message
    return last.value if isinstance(last, ast.Constant) and isinstance(last.value, str) else "."


def test_errors_that_users_see_end_as_sentences() -> None:
    for path in (path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "DeltalightError" and node.args:
                end = literal_end(node.args[0])
                assert end.endswith((".", "?")), f"{path}:{node.lineno} ends with {end!r}"


def test_the_errors_page_quotes_what_the_code_says() -> None:
    text = (DOCS / "errors.md").read_text(encoding="utf-8")
    first_cells = "\n".join(re.findall(r"^\| ([^|]*) \|", text, re.MULTILINE))
    quoted = re.findall(r"`([^`\n]* [^`\n]*)`", first_cells)
    assert len(quoted) > 40
    known = spoken()
    for sentence in quoted:
        for part in re.split(r"\s*\.\.\.\s*|\(\)", sentence):
            bare = part.strip(" ()'`:;,")
            assert bare in known, f"no code says `{bare}` (of `{sentence}`)"
