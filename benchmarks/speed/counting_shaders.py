"""GLSL that counts its own arithmetic, by way of SPIR-V: it writes what it wrote, and sums into a buffer.

glslangValidator makes SPIR-V of a shader, `spirv.counting` adds counters to it, spirv-cross makes GLSL of that again.
Each invocation adds its own sums to the buffer when it ends.
"""

import re
import shutil
import subprocess
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from deltalight.benchmarks.speed.spirv import COUNTERS, counting
from deltalight.protocol.errors import DeltalightError

TOOLS: Final = {"glslangValidator": "glslang-tools", "spirv-cross": "spirv-cross"}
"""The programs that are needed, and Debian's packages of them."""
BLOCK: Final = "CountedArithmetic"
"""The buffer's name: four uint, the low and high words of operations, then those of special functions."""

_LAYOUT = re.compile(r"^layout\((.*)\) (.*)$", re.MULTILINE)
_PLACE = re.compile(r"(location|binding) = ")
_INTERFACE: Final = {"vert": re.compile(r"(flat )?out "), "frag": re.compile(r"(flat )?in ")}
_MAIN = re.compile(r"^void main\(\)$", re.MULTILINE)
_ADDS = "".join(
    f"""    before = atomicAdd(counted_words[{2 * place}], {name});
    if (before + {name} < before) atomicAdd(counted_words[{2 * place + 1}], 1u);
"""
    for place, name in enumerate(COUNTERS)
)
_EPILOGUE: Final = f"""
layout(std430) buffer {BLOCK} {{ uint counted_words[4]; }};

void add_counted()
{{
    uint before;
{_ADDS}}}

void main()
{{
    {"".join(f"{name} = 0u; " for name in COUNTERS)}
    counted_main();
    add_counted();
}}
"""


def require_tools() -> None:
    """Checks that the programs are there.

    Raises:
        DeltalightError: one is missing.
    """
    missing = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if missing:
        raise DeltalightError(
            f"Counting arithmetic needs {' and '.join(TOOLS)}, which translate shaders: "
            f"run `apt-get install {' '.join(missing)}` as root."
        )


@lru_cache(maxsize=1024)
def counting_source(stage: str, source: str) -> str:
    """Returns the GLSL (stage "comp", "vert" or "frag") that counts what it does into the buffer BLOCK.

    Raises:
        DeltalightError: a tool refuses the shader, and says why.
    """
    with TemporaryDirectory() as folder:
        glsl, spirv = Path(folder, f"shader.{stage}"), Path(folder, "shader.spv")
        glsl.write_text(source)
        _run("glslangValidator", "-G", "--aml", "--amb", "-o", str(spirv), str(glsl))
        spirv.write_bytes(counting(spirv.read_bytes()))
        return _with_epilogue(stage, _run("spirv-cross", "--version", "430", "--no-es", str(spirv)))


def _run(tool: str, *arguments: str) -> str:
    done = subprocess.run([tool, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise DeltalightError(f"{tool} refuses a shader: {(done.stdout + done.stderr).strip()}")
    return done.stdout


def _with_epilogue(stage: str, text: str) -> str:
    """Returns spirv-cross' text with the sums' buffer, and with a main that adds to it."""
    text = _LAYOUT.sub(lambda found: _without_places(stage, found[1], found[2]), text)
    is_early = stage == "frag" and "discard;" not in text and "gl_FragDepth" not in text
    head, _, body = text.partition("\n")
    body = body.replace("discard;", "{ add_counted(); discard; }")
    # Shaders that write to buffers are tested against depth after they ran, unless they say otherwise.
    early = "layout(early_fragment_tests) in;\n" if is_early else ""
    return f"{head}\nvoid add_counted();\n{early}{_MAIN.sub('void counted_main()', body)}{_EPILOGUE}"


def _without_places(stage: str, qualifiers: str, declared: str) -> str:
    """Returns a declaration without the places that glslang chose.

    Those of uniforms and buffers are given after linking; linking matches what one stage hands to the next by name.
    """
    interface = _INTERFACE.get(stage)
    is_resource = not {"uniform", "buffer"}.isdisjoint(declared.split())
    if not (is_resource or (interface is not None and interface.match(declared))):
        return f"layout({qualifiers}) {declared}"
    kept = ", ".join(each for each in qualifiers.split(", ") if not _PLACE.match(each))
    return f"layout({kept}) {declared}" if kept else declared
