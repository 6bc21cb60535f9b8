"""Shader source: recursive `#include`, `#line` marks, defines after `#version`, and declared names."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
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
_LOCAL_SIZE = re.compile(r"\blocal_size_([xyz])\s*=\s*(\d+)")


@dataclass(frozen=True)
class Declarations:
    """Names that a shader's source declares, with all branches of its defines.

    `formats` are the formats of images (layout qualifiers; absent for write-only images without one),
    `written` the images and storage blocks that are not `readonly`.
    """

    names: frozenset[str]
    formats: Mapping[str, frozenset[str]]
    written: frozenset[str]
    local_size: tuple[int, int, int]


def shader_source(path: Path, defines: Mapping[str, int | float | str] | None = None) -> str:
    """Returns the source of the shader at `path` with includes (from the shaders' folder) and defines."""
    files: list[Path] = []
    body = _expand(path, files)
    head = [VERSION, *(f"#define {name} {value}" for name, value in (defines or {}).items())]
    table = [f"// file {index}: {file.parent.name}/{file.name}" for index, file in enumerate(files)]
    return "\n".join([*head, *table, body])


def _expand(path: Path, seen: list[Path]) -> str:
    """Returns the source of `path`, with every include that was not yet `seen` replaced by its text."""
    seen.append(path)
    number = len(seen) - 1
    lines = [f"#line 1 {number}"]
    for index, line in enumerate(path.read_text().splitlines(), start=1):
        match = INCLUDE.match(line)
        if match is None:
            lines.append(line)
            continue
        target = SHADERS / match.group(1)
        if target not in seen:
            lines.append(_expand(target, seen))
        lines.append(f"#line {index + 1} {number}")
    return "\n".join(lines)


def declarations(source: str) -> Declarations:
    """Returns what a shader's source declares for its caller."""
    text = _COMMENT.sub(" ", source)
    names: set[str] = set()
    formats: dict[str, frozenset[str]] = {}
    written: set[str] = set()
    for layout, access, kind, declared in _VARIABLE.findall(text):
        for name in (part.strip().split("[")[0].strip() for part in declared.split(",")):
            names.add(name)
            if "image" in kind:
                format_ = {word.strip() for word in layout.split(",")} - {""}
                formats[name] = formats.get(name, frozenset()) | format_
                if "readonly" not in access:
                    written.add(name)
    for access, kind, name in _BLOCK.findall(text):
        names.add(name)
        if kind == "buffer" and "readonly" not in access:
            written.add(name)
    sizes = {axis: int(size) for axis, size in _LOCAL_SIZE.findall(text)}
    local_size = (sizes.get("x", 1), sizes.get("y", 1), sizes.get("z", 1))
    return Declarations(frozenset(names), formats, frozenset(written), local_size)
