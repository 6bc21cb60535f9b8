"""Shader text: recursive `#include`, once each, with `#line` marks and defines after `#version`."""

import re
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
VERSION = "#version 430 core"


def shader_source(path: Path, defines: Mapping[str, int | float | str] | None = None) -> str:
    """Text of the shader at `path` with its includes (paths relative to `render_server/`) and defines."""
    files: list[Path] = []
    body = _expand(path, files)
    head = [VERSION, *(f"#define {name} {value}" for name, value in (defines or {}).items())]
    table = [f"// file {index}: {file.parent.name}/{file.name}" for index, file in enumerate(files)]
    return "\n".join([*head, *table, body])


def _expand(path: Path, seen: list[Path]) -> str:
    """Text of `path` with every include that was not yet `seen` put in its place."""
    seen.append(path)
    number = len(seen) - 1
    lines = [f"#line 1 {number}"]
    for index, line in enumerate(path.read_text().splitlines(), start=1):
        match = INCLUDE.match(line)
        if match is None:
            lines.append(line)
            continue
        target = ROOT / match.group(1)
        if target not in seen:
            lines.append(_expand(target, seen))
        lines.append(f"#line {index + 1} {number}")
    return "\n".join(lines)
