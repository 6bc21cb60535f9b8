"""Shader source: recursive `#include`, `#line` marks, defines after `#version`, and declared names."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

SHADERS = Path(__file__).resolve().parents[1] / "passes" / "shaders"
INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
VERSION = "#version 430 core"

_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_VARIABLE = re.compile(
    r"(?:layout\s*\(([^)]*)\)\s*)?((?:(?:readonly|writeonly|coherent|volatile|restrict)\s+)*)"
    r"\buniform\s+(?:(?:highp|mediump|lowp)\s+)?(\w+)\s+([^;{]+);"
)
_BLOCK = re.compile(
    r"((?:(?:readonly|writeonly|coherent|volatile|restrict)\s+)*)\b(buffer|uniform)\s+(\w+)\s*\{"
)
_SWITCH = re.compile(r"^\s*#\s*pragma\s+switch\s+(?:bool\s+)?(\w+)\s*$", re.MULTILINE)
_CONSTANT = re.compile(r"#pragma switch bool (\w+)")
_VALUE = re.compile(r"^const bool (\w+) = switched;$", re.MULTILINE)
_LOCAL_SIZE = re.compile(r"\blocal_size_([xyz])\s*=\s*(\d+)")
_DIRECTIVE = re.compile(r"\s*#\s*(define|ifdef|ifndef|if|elif|else|endif)\b\s*(\w*)(?:[ \t]+(.*))?")


@dataclass(frozen=True)
class Declarations:
    """What a shader's text declares for its caller.

    `names` are those of all variants; the rest is of the one that the defines leave: `formats` of images (layout
    qualifiers; none where it is written only and has no format), `written` images and storage blocks (all that are
    not `readonly`), and `switches`: defines that the bindings of a run turn on (`#pragma switch NAME`), or constants
    that they make true (`#pragma switch bool name`).
    """

    names: frozenset[str]
    formats: Mapping[str, frozenset[str]]
    written: frozenset[str]
    switches: tuple[str, ...]
    local_size: tuple[int, int, int]


def shader_source(path: Path, defines: Mapping[str, int | float | str] | None = None) -> str:
    """Returns the source of the shader at `path` with includes (from the shaders' folder) and defines."""
    files: list[Path] = []
    body, given = _expand(path, files), defines or {}
    constants = _VALUE.findall(body)
    body = _VALUE.sub(
        lambda found: f"const bool {found[1]} = {'true' if found[1] in given else 'false'};", body
    )
    head = [VERSION, *(f"#define {name} {value}" for name, value in given.items() if name not in constants)]
    table = [f"// file {index}: {file.parent.name}/{file.name}" for index, file in enumerate(files)]
    return "\n".join([*head, *table, body])


def _expand(path: Path, seen: list[Path]) -> str:
    """Returns the source of `path`, with every include that was not yet `seen` replaced by its text."""
    seen.append(path)
    number = len(seen) - 1
    lines = [f"#line 1 {number}"]
    for index, line in enumerate(path.read_text().splitlines(), start=1):
        if constant := _CONSTANT.match(line):
            lines += [constant[0], f"const bool {constant[1]} = switched;", f"#line {index + 1} {number}"]
            continue
        match = INCLUDE.match(line)
        if match is None:
            lines.append(line)
            continue
        target = SHADERS / match.group(1)
        if target not in seen:
            lines.append(_expand(target, seen))
        lines.append(f"#line {index + 1} {number}")
    return "\n".join(lines)


@lru_cache(
    maxsize=512
)  # every shader of the project, in all its variants: renderers are made again and again
def declarations(source: str) -> Declarations:
    """What the text of a shader, with its defines, declares."""
    text = _COMMENT.sub(" ", source)
    whole = _declaring(text)
    names = {name for _, _, _, name in _variables(whole)} | {name for _, _, name in _BLOCK.findall(whole)}
    text = preprocessed(text)
    sizes = {axis: int(size) for axis, size in _LOCAL_SIZE.findall(text)}
    switches = tuple(dict.fromkeys(_SWITCH.findall(text)))
    names |= set(switches)
    text = _declaring(text)
    formats: dict[str, frozenset[str]] = {}
    written: set[str] = set()
    for layout, access, kind, name in _variables(text):
        if "image" in kind:
            formats[name] = frozenset(word.strip() for word in layout.split(",")) - {""}
            written |= set() if "readonly" in access else {name}
    for access, kind, name in _BLOCK.findall(text):
        written |= {name} if kind == "buffer" and "readonly" not in access else set()
    local_size = (sizes.get("x", 1), sizes.get("y", 1), sizes.get("z", 1))
    return Declarations(frozenset(names), formats, frozenset(written), switches, local_size)


def _declaring(text: str) -> str:
    """Returns the statements that may declare a uniform or a block: few of a shader's, which saves time."""
    return ";".join([part for part in text.split(";") if "uniform" in part or "buffer" in part]) + ";"


def _variables(text: str) -> Iterator[tuple[str, str, str, str]]:
    """Layout, access, type and name of each uniform variable."""
    for layout, access, kind, declared in _VARIABLE.findall(text):
        for part in declared.split(","):
            yield layout, access, kind, part.split("[")[0].strip()


def preprocessed(text: str) -> str:
    """What `#ifdef` and `#ifndef` leave of a text without comments, macros without parameters expanded.

    Conditions of `#if` and `#elif` are not computed: what hangs on them stays.
    """
    macros: dict[str, str] = {}
    named = re.compile("(?!)")  # any of the macros; none yet
    branches: list[bool | None] = []  # of the conditions around a line: taken or not, None: not computed
    lines = []
    for line in text.splitlines():
        directive = _DIRECTIVE.match(line)
        if directive is None:
            if False not in branches:
                lines.append(named.sub(lambda word: macros[word[0]], line))
            continue
        kind, name, value = directive.groups()
        if kind == "define" and False not in branches:
            macros[name] = value or ""
            named = re.compile(rf"\b(?:{'|'.join(macros)})\b")
        elif kind in ("ifdef", "ifndef"):
            branches.append((name in macros) == (kind == "ifdef"))
        elif kind == "if":
            branches.append(None)
        elif kind == "elif":
            branches[-1] = None
        elif kind == "else":
            branches[-1] = None if branches[-1] is None else not branches[-1]
        elif kind == "endif":
            branches.pop()
    return "\n".join(lines)
