"""What a shader's text declares, once its branches are resolved."""

import re
from pathlib import Path

import pytest

from deltalight.render_server.gpu.shader_source import (
    declarations,
    expand_macros,
    preprocessed,
    shader_source,
)


def test_declarations_are_those_that_the_defines_leave() -> None:
    source = """
#define SIZE 8
#define GRID_ACCESS readonly
#ifdef SIZE
layout(local_size_x = SIZE, local_size_y = 4) in;
layout(std430) GRID_ACCESS buffer Grid { uint grid[]; };
#else
layout(local_size_x = 1) in;
layout(std430) buffer Grid { uint grid[]; };
#endif
#ifndef REAL
layout(std430) buffer Sums { int sums[]; };  // layout(std430) buffer Comment { int comment[]; };
/* uniform sampler2D commented; */
layout(rgba16f) writeonly uniform image2D a, b;
#else
#ifdef SIZE
layout(r32f) readonly uniform image2D a;
#endif
#endif
#if SIZE == 9
layout(std430) buffer Kept { int kept[]; };
#endif
uniform vec3 colors[4], tint;
"""
    virtual = declarations(source)
    assert virtual.names == {"Grid", "Sums", "a", "b", "Kept", "colors", "tint"}
    assert virtual.local_size == (8, 4, 1)
    assert virtual.written == {"Sums", "a", "b", "Kept"}
    assert virtual.formats == {"a": {"rgba16f"}, "b": {"rgba16f"}}
    real = declarations("#define REAL 1\n" + source)
    assert real.names == virtual.names
    assert real.written == {"Kept"}
    assert real.formats == {"a": {"r32f"}}


def test_branches_nest_and_uncomputed_ones_stay() -> None:
    text = "\n".join(
        [
            "#define A",
            "#ifdef A",
            "#ifdef B",
            "1",
            "#else",
            "2",
            "#define C 7",
            "#endif",
            "#else",
            "#define C 8",
            "3",
            "#endif",
            "#ifdef B",
            "4",
            "#elif defined(A)",
            "5",
            "#else",
            "6",
            "#endif",
            "C",
        ]
    )
    assert expand_macros(*preprocessed(text)).split() == ["2", "5", "6", "7"]


def test_a_workgroup_size_that_hangs_on_an_uncomputed_condition_is_refused() -> None:
    """Taken from the wrong branch, it would dispatch a multiple of the workgroups, whose results are the same."""
    size = "layout(local_size_x = {}, local_size_y = 4) in;"
    source = "\n".join(
        ["#ifdef B", size.format(1), "#elif defined(A)", size.format(8), "#else", size.format(4), "#endif"]
    )
    assert declarations(
        "#define B\n" + source.replace("#elif defined(A)", "#else\n#ifdef A") + "\n#endif"
    ).local_size == (1, 4, 1)
    with pytest.raises(ValueError, match="several workgroup sizes"):
        declarations("#define A\n" + source)


def _including(folder: Path, text: str) -> Path:
    """A shader of that text, in which <name> stands for the include of a file that declares `name`."""
    for name in ("one", "two"):
        (folder / f"{name}.glsl").write_text(f"int {name};")
    (folder / "both.glsl").write_text(
        "\n".join(f'#include "{folder / name}.glsl"' for name in ("one", "two"))
    )
    path = folder / "main.glsl"
    path.write_text(re.sub(r"<(\w+)>", lambda found: f'#include "{folder / found[1]}.glsl"', text))
    return path


@pytest.mark.parametrize(
    "text",
    [
        "#ifdef A\n<one>\n#endif\n<one>",
        "#ifdef A\n<both>\n#endif\n<two>",
        "#ifdef A\n<one>\n#else\n<one>\n#endif",
        "#ifndef A\n<one>\n#endif\n#ifdef A\n<one>\n#endif",
        "#ifdef A\n#ifdef B\n<one>\n#endif\n<one>\n#endif",
        "#if A == 1\n<one>\n#elif A == 2\n<one>\n#endif",
        "#if A == 1\n#elif A == 2\n<one>\n#else\n<one>\n#endif",
    ],
)
def test_a_file_whose_text_a_condition_may_leave_out_is_not_included_again(tmp_path: Path, text: str) -> None:
    """Where the first include is left out, what stands there would be missing below."""
    with pytest.raises(
        ValueError, match=r"whose text stands under .* only; include it before that condition"
    ):
        shader_source(_including(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    [
        "<one>\n#ifdef A\n<one>\n#endif",
        "#ifdef A\n<one>\n#ifdef B\n<one>\n#endif\n#endif",
        "#ifdef A\n<both>\n#endif\n# ifdef  A  // again\n<two>\n#endif",
        "#ifdef A\n#else\n<one>\n#endif\n#ifndef A\n<one>\n#endif",
        "#ifndef A\n#else\n<one>\n#endif\n#ifdef A\n<one>\n#endif",
    ],
)
def test_a_file_is_included_once_where_its_text_is_there_again(tmp_path: Path, text: str) -> None:
    assert shader_source(_including(tmp_path, text)).count("int one;") == 1
