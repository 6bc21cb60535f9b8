"""Modules of protocol and services import each other one way; benchmarks are reached through one module; a render
server starts without what it may never need."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from tests.services.conftest import ROOT

PACKAGES = ("protocol", "services")
BENCHMARKS_ENTRY = "deltalight.benchmarks.cli"
# Most of a second, by which a render server that was killed would be away longer.
SLOW_TO_IMPORT = {"scipy", "trimesh"}


@cache
def imports() -> dict[str, set[str]]:
    """What each module imports, also inside of functions."""
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    dashboard = ROOT / "services" / "dashboard"
    return {
        ".".join(("deltalight", *path.relative_to(ROOT).with_suffix("").parts)): imported(path.read_text())
        for path in paths
        if not path.is_relative_to(dashboard)
    }


def imported(text: str) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found.update(each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found.add(node.module)
            found.update(f"{node.module}.{each.name}" for each in node.names)
    return found


def test_no_modules_import_each_other_in_a_circle() -> None:
    known = imports()
    order = TopologicalSorter({name: found & known.keys() for name, found in known.items()}).static_order()
    assert len(list(order)) == len(known) > 100


def test_benchmarks_are_imported_through_their_entry_alone() -> None:
    found = {
        each for names in imports().values() for each in names if each.startswith("deltalight.benchmarks")
    }
    assert {each for each in found if not each.startswith(BENCHMARKS_ENTRY)} == set()
    assert BENCHMARKS_ENTRY in found


def test_render_servers_import_slow_libraries_where_they_use_them() -> None:
    for path in (ROOT / "render_server").rglob("*.py"):
        found = {name.split(".")[0] for name in imported_when_loaded(path)}
        assert not found & SLOW_TO_IMPORT, path


def test_aiortc_is_imported_when_somebody_watches_by_whep() -> None:
    webrtc = ROOT / "services" / "api" / "webrtc.py"
    assert "aiortc" in imported_when_loaded(webrtc)
    for path in {*(ROOT / "services").rglob("*.py")} - {webrtc}:
        found = imported_when_loaded(path)
        assert not {name for name in found if name.startswith("aiortc") or name.endswith(".webrtc")}, path


def imported_when_loaded(path: Path) -> set[str]:
    lines = ast.parse(path.read_text()).body
    when_loaded = [line for line in lines if isinstance(line, ast.Import | ast.ImportFrom)]
    return {name for line in when_loaded for name in imported(ast.unparse(line))}
