"""Comments cite docs/method.md and docs/formats.md by section: what they cite exists."""

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("method", "formats")
SUFFIXES = (".py", ".glsl", ".ts", ".tsx")

GAP = r"""(?:[ ]?["']?\s*\n\s*(?://|\#|\*|["'])?\s*|[ ])"""
"""A space, or a line break within a comment or a string in parts."""

NUMBER = r"\d+(?:\.\d+)?"
CITATION = re.compile(
    rf"docs/(method|formats)\.md{GAP}({NUMBER}[a-z]?\b(?:(?:,|{GAP}and|{GAP}to){GAP}{NUMBER}[a-z]?\b)*)"
)
UNPUBLISHED = re.compile(rf"\b(?:METHOD|FORMATS){GAP}\d")
HEADING = re.compile(rf"^\#{{2,4}} ({NUMBER}) \S", re.MULTILINE)


def cited_sections(numbers: str) -> list[str]:
    """Returns the sections that a list such as `3, 4.5`, `3 and 4` or `4.1 to 4.3` names."""
    found: list[str] = []
    for link, number in re.findall(rf"(to\b)?[^\w.]*({NUMBER})", numbers):
        if link:
            parent, dot, first = found[-1].rpartition(".")
            last = number.removeprefix(parent + dot)
            found += [f"{parent}{dot}{index}" for index in range(int(first) + 1, int(last))]
        found.append(number)
    return found


@cache
def sections(page: str) -> frozenset[str]:
    return frozenset(HEADING.findall((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")))


def tracked_sources() -> Iterator[tuple[str, str]]:
    """Yields name and text of every source file that git tracks."""
    if not (ROOT / ".git").exists():
        pytest.skip("this is no git checkout, so what belongs to the project is not known")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True)
    for name in listed.stdout.split("\0"):
        if name.endswith(SUFFIXES) and (ROOT / name).is_file():
            yield name, (ROOT / name).read_text(encoding="utf-8")


def place(name: str, text: str, match: re.Match[str]) -> str:
    return f"{name}:{text.count(chr(10), 0, match.start()) + 1}: {' '.join(match.group().split())}"


@pytest.mark.parametrize("page", PAGES)
def test_headings_are_numbered_once(page: str) -> None:
    found = HEADING.findall((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"))
    assert found
    assert len(found) == len(set(found))


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("4.5)", ["4.5"]),
        ("3, direct", ["3"]),
        ("4.5b", ["4.5"]),
        ("3, 4.5 and 7.", ["3", "4.5", "7"]),
        ("3 to 5", ["3", "4", "5"]),
        ("4.1 to 4.3", ["4.1", "4.2", "4.3"]),
        ("3 and\n// 4", ["3", "4"]),
        ('"\n    "10.2', ["10.2"]),
    ],
)
def test_forms_of_citations(written: str, meant: list[str]) -> None:
    match = CITATION.search(f"({'docs/method' + '.md'} {written}")
    assert match is not None
    assert cited_sections(match.group(2)) == meant


def test_cited_sections_exist() -> None:
    missing = [
        place(name, text, match)
        for name, text in tracked_sources()
        for match in CITATION.finditer(text)
        if not sections(match.group(1)).issuperset(cited_sections(match.group(2)))
    ]
    assert not missing, "\n".join(missing)


def test_the_tests_that_the_security_page_names_exist() -> None:
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    named = re.findall(r"`([a-z_/]+\.py): (test_\w+)`", page)
    assert named
    for file, test in named:
        assert f"def {test}(" in (ROOT / "tests" / file).read_text(encoding="utf-8"), (file, test)


def test_unpublished_documents_are_not_cited() -> None:
    found = [
        place(name, text, match) for name, text in tracked_sources() for match in UNPUBLISHED.finditer(text)
    ]
    assert not found, "\n".join(found)
