"""What the site needs beyond MkDocs: pages for files outside of docs/ and for notebooks, formulas without scripts."""

import json
import posixpath
import re
from collections.abc import Iterator
from contextlib import suppress
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
API = ROOT / "build" / "api" / "deltalight"
ROOMS = ("protocol", "sensor_node", "render_server", "services", "benchmarks")
OUTSIDE = "source/"  # where the site has the files that lie beside docs/
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|[#/])([^)#\s]+)(?=[)#])")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
LEXERS = {".py": "python", ".yml": "yaml", ".toml": "toml"}


@event_priority(100)  # mkdocstrings drops paths that do not exist yet
def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Lays out the package as wheels have it, because griffe reads sources and knows no `__path__`."""
    API.mkdir(parents=True, exist_ok=True)
    parts = [*(ROOT / "deltalight").glob("*.py"), *(ROOT / room for room in ROOMS)]
    for part in parts:
        link = API / part.name
        if not link.exists():
            link.unlink(missing_ok=True)
            with suppress(FileExistsError):  # of a build beside this one
                link.symlink_to(part)
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds a page for each notebook, and for each file or folder outside of docs/ that a page leads to."""
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        text = notebook_page(Path(str(notebook.abs_src_path)))
        files.append(File.generated(config, page_uri("docs/" + notebook.src_uri), content=text))
    waiting = [("docs/" + file.src_uri, file.content_string) for file in files.documentation_pages()]
    while waiting:
        place, text = waiting.pop()
        for target in targets(place, text):
            uri = page_uri(target)
            if target.startswith("docs/") or files.get_file_from_path(uri) or not (ROOT / target).exists():
                continue
            files.append(File.generated(config, uri, content=source_page(target)))
            if target.endswith(".md"):
                waiting.append((target, (ROOT / target).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns links that hold in the repository into those of the site."""
    uri = page.file.src_uri
    here = uri.removeprefix(OUTSIDE) if uri.startswith(OUTSIDE) else "docs/" + uri

    def moved(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(here), match[1]))
        return posixpath.relpath(page_uri(target), posixpath.dirname(uri) or ".")

    return LINK.sub(moved, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Sets formulas as MathML, which browsers draw by themselves."""
    return FORMULA.sub(_mathml, html)


def _mathml(match: re.Match[str]) -> str:
    return convert(unescape(match[2]), display="block" if match[1] == "div" else "inline")


def targets(place: str, text: str) -> Iterator[str]:
    """Yields the files, relative to the project, that the links of a page at `place` lead to."""
    for link in LINK.findall(text):
        yield posixpath.normpath(posixpath.join(posixpath.dirname(place), link))


def page_uri(target: str) -> str:
    """Returns where the site has a file of the project."""
    if target.startswith("docs/"):
        inside = target.removeprefix("docs/")
        return re.sub(r"\.ipynb$", ".md", inside)
    return OUTSIDE + target if target.endswith(".md") else f"{OUTSIDE}{target}.md"


def source_page(target: str) -> str:
    """Returns a page that shows a file, or what a folder holds."""
    path = ROOT / target
    if target.endswith(".md"):
        return path.read_text(encoding="utf-8")
    if path.is_dir():
        body = "\n".join(f"* `{item.name}`" for item in sorted(path.iterdir()) if item.name[0] not in "._")
    else:
        body = f"````{LEXERS.get(path.suffix, 'text')}\n{path.read_text(encoding='utf-8')}\n````"
    return f"---\nsearch: {{exclude: true}}\n---\n# {target}\n\n{body}\n"


def notebook_page(path: Path) -> str:
    """Returns a notebook's cells as a page."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = []
    for cell in cells:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    parts.append(f'<a href="{path.name}" download>Download this page as a notebook</a>')
    return "\n\n".join(parts) + "\n"
