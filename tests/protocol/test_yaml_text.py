"""YAML documents within limits: what says much in few bytes is refused before anything is built."""

from pathlib import Path

import pytest

from deltalight.protocol.documents import parse_mapping
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import load_scene
from deltalight.protocol.yaml_text import MAX_DEPTH, MAX_TEXT, MAX_VALUES, parse_yaml, yaml_text


def nested(depth: int, line: str) -> str:
    """A document whose every line names the line before it several times."""
    lines = (f"a{level}: &a{level} {line.format(f'*a{level - 1}')}\n" for level in range(1, depth))
    return "a0: &a0 {x: 1}\n" + "".join(lines)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (nested(18, "{{<<: [{0}, {0}]}}"), "100000 values"),
        (nested(9, "[{0}, {0}, {0}, {0}, {0}]"), "100000 values"),
        ("- 1\n" * (MAX_VALUES + 1), "100000 values"),
        ("[" * (MAX_DEPTH + 1), "deeper than 32"),
        ("- " * 900_000, "deeper than 32"),
        ("a: &a [*a]", "nothing that is complete"),
        ("a: *b", "nothing that is complete"),
        ("a: &a 1\nb: &a 2", "duplicate anchor"),
        (f"a: {'x' * (MAX_TEXT + 1)}", "4096 characters"),
        (f"a: 0x{'f' * 4000}", "64 bits"),
        (f"a: {'1:' * 2000}1", "64 bits"),
        (f"a: {'1:' * 2000}1.5", "too large"),
        ("a: 2026-99-99", "month must be"),
        ("a: !!int ''", "tag"),
        ("a: !!python/name:os.system x", "tag"),
        ('a: "\\ud800"', "character"),
        ("objects: [1]\nobjects: [2]", "`objects` appears twice at line 2, column 1"),
        ("a: {b: 1, c: 2, b: 3}", "`b` appears twice"),
        ("a: [", "not valid YAML"),
    ],
)
def test_what_exceeds_a_limit_is_one_sentence(text: str, reason: str) -> None:
    with pytest.raises(DeltalightError, match=reason) as fault:
        parse_mapping(text, "the document", is_json=False)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize(
    ("text", "place"), [("objects:\n\t- a\n", "at line 2, column 1"), ("\x02", "at position 0")]
)
def test_the_place_of_a_fault_is_that_in_the_document(text: str, place: str) -> None:
    with pytest.raises(DeltalightError, match=f" {place}") as fault:
        parse_mapping(text, "scene.yaml", is_json=False)
    assert "unicode string" not in str(fault.value)


def test_scene_files_of_the_command_line_have_the_same_limits(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(nested(18, "{{<<: [{0}, {0}]}}"))
    with pytest.raises(DeltalightError, match=r"scene\.yaml is not valid YAML .*100000 values"):
        load_scene(path)


def test_anchors_and_merge_keys_that_stay_small_are_read() -> None:
    text = (
        "base: &base {a: 1, b: 1e-3}\nitem: {<<: *base, a: 2}\nagain: *base\n"  # `a` is replaced, not doubled
    )
    assert parse_yaml(text) == {
        "base": {"a": 1, "b": 1e-3},
        "item": {"a": 2, "b": 1e-3},
        "again": {"a": 1, "b": 1e-3},
    }


def test_what_is_written_is_read_back() -> None:
    data = {"text": "12e3", "number": 12e3, "list": [1, None, True, "no", "2026-01-01", "ü\n"]}
    assert parse_yaml(yaml_text(data)) == data
