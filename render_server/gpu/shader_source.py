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
_WORD = re.compile(r"\b[A-Za-z_]\w*")
_LOCAL_SIZE = re.compile(r"\blocal_size_([xyz])\s*=\s*(\d+)")
_CONDITION = re.compile(r"^\s*#\s*(ifdef|ifndef|if|elif|else|endif)\b\s*(.*?)\s*(?://.*)?$")
# A number sign begins nothing else in GLSL, and is found sooner than the beginning of a line.
_DIRECTIVE = re.compile(
    r"#[ \t]*(define|ifdef|ifndef|if|elif|else|endif)\b[ \t]*(\w*)(?:[ \t]+(.*))?.*$", re.MULTILINE
)


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
    """Returns the source of the shader at `path` with includes (from the shaders' folder) and defines.

    A process reads each shader once (`expanded`).

    Raises:
        ValueError: a file is included again where its text, which is under a condition, may be missing.
    """
    given = tuple((name, str(value)) for name, value in (defines or {}).items())
    return _assembled(*expanded(path), given)


@lru_cache(maxsize=512)  # every shader of the project: renderers are made again and again
def expanded(path: Path) -> tuple[str, str]:
    """Returns the text of a shader with its includes, and a table of their files."""
    files: dict[Path, frozenset[str]] = {}
    body = _expand(path, files, frozenset())
    return body, "\n".join(
        f"// file {index}: {file.parent.name}/{file.name}" for index, file in enumerate(files)
    )


@lru_cache(maxsize=1024)  # in all variants, and for watchers too
def _assembled(body: str, table: str, defines: tuple[tuple[str, str], ...]) -> str:
    given, constants = dict(defines), _VALUE.findall(body)
    body = _VALUE.sub(
        lambda found: f"const bool {found[1]} = {'true' if found[1] in given else 'false'};", body
    )
    head = [VERSION, *(f"#define {name} {value}" for name, value in given.items() if name not in constants)]
    return "\n".join([*head, table, body, ""])  # NVIDIA refuses a `#line` that no line break follows


def _expand(path: Path, seen: dict[Path, frozenset[str]], around: frozenset[str]) -> str:
    """Returns the source of `path`, which stands under conditions, with the text of every include not yet `seen`.

    `seen` holds under which conditions each file's text stands. Conditions are compared as they are written.
    """
    number, seen[path] = len(seen), around
    lines = [f"#line 1 {number}"]
    for before, target, own, next_line in _split(path.read_text()):
        lines += before
        if target is not None and target not in seen:
            lines.append(_expand(target, seen, around | own))
        elif target is not None and not seen[target] <= around | own:
            missing = " and ".join(f"`{condition}`" for condition in sorted(seen[target] - around - own))
            raise ValueError(
                f"{path.name} includes {target.name}, whose text stands under {missing} only; "
                "include it before that condition."
            )
        if next_line:
            lines.append(f"#line {next_line} {number}")
    return "\n".join(lines)


@lru_cache(maxsize=512)  # every file of the project: renderers are made again and again
def _split(text: str) -> list[tuple[list[str], Path | None, frozenset[str], int]]:
    """Splits a file at includes and constants.

    Of each part: the lines before, what is included, under which conditions of the file, and the number of the next
    line, if any.
    """
    parts: list[tuple[list[str], Path | None, frozenset[str], int]] = []
    before: list[str] = []
    conditions: list[str] = []
    for index, line in enumerate(text.splitlines(), start=1):
        match, constant = INCLUDE.match(line), _CONSTANT.match(line)
        _follow_conditions(line, conditions)
        if constant:
            before += [constant[0], f"const bool {constant[1]} = switched;"]
        if not (match or constant):
            before.append(line)
        else:
            parts.append((before, SHADERS / match[1] if match else None, frozenset(conditions), index + 1))
            before = []
    return [*parts, (before, None, frozenset(), 0)]


def _follow_conditions(line: str, conditions: list[str]) -> None:
    """Enters, switches or leaves a condition where a line says so."""
    found = _CONDITION.match(line)
    if found is None:
        return
    kind, condition = found[1], " ".join(found[2].split())
    otherwise = "" if kind in ("ifdef", "ifndef", "if") else conditions.pop()
    if kind == "ifdef":
        conditions.append(condition)
    elif kind in ("ifndef", "if"):
        conditions.append(f"!{condition}" if kind == "ifndef" else f"({condition})")
    elif kind in ("elif", "else"):
        negated = otherwise[1:] if otherwise.startswith("!") else f"!{otherwise}"
        conditions.append(negated if kind == "else" else f"{negated} && ({condition})")


@lru_cache(
    maxsize=512
)  # every shader of the project, in all its variants: renderers are made again and again
def declarations(source: str) -> Declarations:
    """What the text of a shader, with its defines, declares.

    Raises:
        ValueError: conditions that are not computed leave several workgroup sizes.
    """
    whole = _declaring(without_comments(source))
    names = {name for _, _, _, name in _variables(whole)} | {name for _, _, name in _BLOCK.findall(whole)}
    kept, macros = preprocessed(source)
    text = expand_macros(_declaring(kept), macros)
    switches = tuple(dict.fromkeys(_SWITCH.findall(kept)))
    names |= set(switches)
    formats: dict[str, frozenset[str]] = {}
    written: set[str] = set()
    for layout, access, kind, name in _variables(text):
        if "image" in kind:
            formats[name] = frozenset(word.strip() for word in layout.split(",")) - {""}
            written |= set() if "readonly" in access else {name}
    for access, kind, name in _BLOCK.findall(text):
        written |= {name} if kind == "buffer" and "readonly" not in access else set()
    return Declarations(frozenset(names), formats, frozenset(written), switches, _local_size(text))


@lru_cache(maxsize=512)
def without_comments(source: str) -> str:
    """Returns a shader's text with blanks in place of comments."""
    return _COMMENT.sub(" ", source)


@lru_cache(maxsize=512)
def preprocessed(source: str) -> tuple[str, Mapping[str, str]]:
    """Returns what `#ifdef` and `#ifndef` leave of a shader's text, without comments, and macros without parameters.

    Conditions of `#if` and `#elif` are not evaluated: the text below them stays.
    """
    return _kept(without_comments(source))


def _local_size(text: str) -> tuple[int, int, int]:
    found = set(_LOCAL_SIZE.findall(text))
    sizes = {axis: int(size) for axis, size in found}
    if len(found) > len(sizes):
        raise ValueError(
            "A shader declares several workgroup sizes; choose between them by #ifdef, not by #elif."
        )
    return sizes.get("x", 1), sizes.get("y", 1), sizes.get("z", 1)


def _declaring(text: str) -> str:
    """Returns the statements that may declare a uniform, a block or a size; parsing only these saves time."""
    parts = text.split(";")
    return ";".join([p for p in parts if "uniform" in p or "buffer" in p or "local_size" in p]) + ";"


def _variables(text: str) -> Iterator[tuple[str, str, str, str]]:
    """Layout, access, type and name of each uniform variable."""
    for layout, access, kind, declared in _VARIABLE.findall(text):
        for part in declared.split(","):
            yield layout, access, kind, part.split("[")[0].strip()


def _kept(text: str) -> tuple[str, dict[str, str]]:
    """Returns what conditions leave of a text, and the macros that are defined there."""
    macros: dict[str, str] = {}
    branches: list[bool | None] = []  # of the conditions around a place: taken or not, None: not computed
    kept, at = [], 0
    for directive in _DIRECTIVE.finditer(text):
        if False not in branches:
            kept.append(text[at : directive.start()])
        at = directive.end()
        kind, name, value = directive.groups()
        if kind != "define":
            _update_branches(kind, name in macros, branches)
        elif False not in branches:
            macros[name] = value or ""
    return "".join([*kept, text[at:]]), macros


def _update_branches(kind: str, is_defined: bool, branches: list[bool | None]) -> None:
    """Enters, switches or leaves a branch of conditions."""
    if kind in ("ifdef", "ifndef"):
        branches.append(is_defined == (kind == "ifdef"))
    elif kind == "if":
        branches.append(None)
    elif kind == "elif":
        branches[-1] = None
    elif kind == "else":
        branches[-1] = None if branches[-1] is None else not branches[-1]
    else:
        branches.pop()


def expand_macros(text: str, macros: Mapping[str, str]) -> str:
    """Returns a text with macros in place of their names."""
    return _WORD.sub(lambda word: macros.get(word[0], word[0]), text) if macros else text
