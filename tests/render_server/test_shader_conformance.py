"""Every shader variant that the renderer compiles conforms to GLSL and keeps within what OpenGL 4.3 guarantees.

Mesa accepts more than the language allows, and has more of everything than drivers must have.
"""

import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pytest

from deltalight.benchmarks.gpu_check.child import take_step
from deltalight.benchmarks.gpu_check.record import Findings, State
from deltalight.benchmarks.speed.instruments import ReadBacks
from deltalight.render_server.gpu.context import NEEDED, GpuContext
from deltalight.render_server.gpu.program_slots import IMAGES, SAMPLERS
from deltalight.render_server.gpu.shader_source import SHADERS, VERSION
from tests.render_server import shader_variants

VALIDATOR = shutil.which("glslangValidator")
pytestmark = [
    pytest.mark.slow(seconds=60),
    pytest.mark.skipif(VALIDATOR is None, reason="glslangValidator (package glslang-tools) is not installed"),
]

# What every implementation of OpenGL 4.3 has at least, for a shader of each stage.
GUARANTEED: Mapping[str, Mapping[str, int]] = {
    "vert": {"storage blocks": 0, "samplers": 16, "images": 0, "uniform blocks": 12},
    "frag": {"storage blocks": 8, "samplers": 16, "images": 8, "uniform blocks": 12},
    "comp": {
        "storage blocks": 8,
        "samplers": 16,
        "images": 8,
        "uniform blocks": 12,
        "shared bytes": 32768,
        "invocations": 1024,
    },
}
REFUSED_BELOW = {  # what a device without is refused
    "storage blocks": "GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS",
    "samplers": "GL_MAX_COMPUTE_TEXTURE_IMAGE_UNITS",
    "images": "GL_MAX_COMPUTE_IMAGE_UNIFORMS",
    "uniform blocks": "GL_MAX_COMPUTE_UNIFORM_BLOCKS",
    "shared bytes": "GL_MAX_COMPUTE_SHARED_MEMORY_SIZE",
    "invocations": "GL_MAX_COMPUTE_WORK_GROUP_INVOCATIONS",
}
ELEMENT_BYTES = {"float": 4, "int": 4, "uint": 4, "bool": 4, "vec2": 8, "vec3": 16, "vec4": 16}
BLOCK = re.compile(r"\b(buffer|uniform)\s+\w+\s*\{")
UNIFORM = re.compile(r"^(\w+).*: offset -1, type (\w+), size (\d+)", re.MULTILINE)
LOCAL_SIZE = re.compile(r"^Local size [XYZ]: (\d+)", re.MULTILINE)
SHARED = re.compile(r"\bshared\s+(\w+)\s+\w+\s*\[([^\]]+)\]")
CONSTANT = re.compile(r"\bconst\s+int\s+(\w+)\s*=\s*([^;,]+);")


@dataclass(frozen=True)
class Shader:
    """One stage of a program: which, its text, and the file that the validator reads."""

    stage: str
    text: str
    path: Path

    @cached_property
    def linked(self) -> str:
        """What glslangValidator says of it as a program of its own: faults, and what the program uses."""
        return validator("-l", "-q", self.path)


def validator(*arguments: str | Path) -> str:
    """What glslangValidator says."""
    assert VALIDATOR is not None
    return subprocess.run([VALIDATOR, *arguments], capture_output=True, text=True, check=False).stdout


Programs = dict[str, list[Shader]]


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> Findings:
    """Step `shaders` of `gpu-check`, not yet taken."""
    folder = tmp_path_factory.mktemp("step")
    return Findings(folder / "record.json", folder, folder)


@pytest.fixture(scope="module")
def programs(step: Findings, tmp_path_factory: pytest.TempPathFactory) -> Programs:
    """The programs that rendering compiles, and those that only a GPU would need, by label: those of the step."""
    folder = tmp_path_factory.mktemp("shaders")
    found: Programs = {}

    def keep(label: str, sources: Mapping[str, str]) -> None:
        if label not in found:
            found[label] = []
            for stage, text in sources.items():
                path = folder / f"{len(found)}.{stage}"
                path.write_text(text)
                found[label].append(Shader(stage, text, path))

    def begin(gpu: GpuContext, folder: Path) -> None:  # noqa: ARG001
        gpu.compile_watchers.append(keep)

    # Programs are linked but do not run, which spares the driver the machine code: other tests render.
    with pytest.MonkeyPatch.context() as patch, ReadBacks().without_gpu():
        patch.setattr(shader_variants, "PARTS", {"begin": begin, **shader_variants.PARTS})
        take_step("deltalight.benchmarks.gpu_check.steps:shaders", step)
    return found


def test_the_driver_takes_them_all_and_gpu_check_lists_them(programs: Programs, step: Findings) -> None:
    assert step.record.state is State.PASSED, step.record
    assert step.record.figures["variants"] == sorted(programs)


def shaders_of(programs: Programs) -> Iterator[tuple[str, Shader]]:
    for label, shaders in programs.items():
        for shader in shaders:
            yield f"{label} ({shader.stage})", shader


def test_every_shader_of_the_project_is_among_them(programs: Programs) -> None:
    compiled = {(label.split()[0], shader.stage) for label, shaders in programs.items() for shader in shaders}
    there = {tuple(path.name.removesuffix(".glsl").split(".")) for path in SHADERS.glob("*.glsl")}
    assert compiled == there


def test_every_variant_is_valid_glsl(programs: Programs) -> None:
    said = {name: shader.linked for name, shader in shaders_of(programs)}
    assert {name: text for name, text in said.items() if "ERROR" in text or "WARNING" in text} == {}
    assert len(said) > 90


def test_no_variant_needs_more_than_opengl_guarantees(programs: Programs) -> None:
    named = dict(shaders_of(programs))
    texts = preprocessed(named.values())
    needs = {
        (name, shader.stage): needs_of(shader, text)
        for (name, shader), text in zip(named.items(), texts, strict=True)
    }
    for (name, _), needed in needs.items():  # shown with a failure
        print(f"{name:60} " + ", ".join(f"{count} {kind}" for kind, count in needed.items() if count))
    beyond = {
        name: {kind: count for kind, count in needed.items() if count > GUARANTEED[stage][kind]}
        for (name, stage), needed in needs.items()
    }
    assert {name: kinds for name, kinds in beyond.items() if kinds} == {}
    assert max(needed["storage blocks"] for needed in needs.values()) == 8
    assert GUARANTEED["comp"] == {kind: NEEDED[name] for kind, name in REFUSED_BELOW.items()}
    assert max(needed.get("shared bytes", 0) for needed in needs.values()) > 16384


def preprocessed(shaders: Iterable[Shader]) -> list[str]:
    """The text of each without conditions and macros, by one run of the validator: most of a run is its start."""
    _, *texts = validator("-E", *(shader.path for shader in shaders)).split(f"{VERSION}\n")
    return texts


def needs_of(shader: Shader, text: str) -> dict[str, int]:
    """What a shader takes of each thing that is limited, of its `preprocessed` text and what its program uses.

    Blocks count as soon as they are declared (std140 and std430 keep unused ones), textures and images where used.
    """
    reflection = shader.linked
    blocks = BLOCK.findall(text)
    needs = {
        "storage blocks": blocks.count("buffer"),
        "uniform blocks": blocks.count("uniform"),
        "samplers": 0,
        "images": 0,
    }
    for _, kind, count in UNIFORM.findall(reflection):
        for name, kinds in (("samplers", SAMPLERS), ("images", IMAGES)):
            needs[name] += int(count) if int(kind, 16) in kinds else 0
    if shader.stage == "comp":
        needs["shared bytes"] = shared_bytes(text)
        needs["invocations"] = 1
        for size in LOCAL_SIZE.findall(reflection):
            needs["invocations"] *= int(size)
    return needs


def shared_bytes(text: str) -> int:
    """Shared memory of a preprocessed shader."""
    constants = dict(CONSTANT.findall(text))

    def value(expression: str) -> int:
        plain = re.sub(r"\b[A-Za-z_]\w*", lambda name: str(value(constants[name[0]])), expression)
        return int(eval(plain, {"__builtins__": {}}))

    return sum(ELEMENT_BYTES[kind] * value(length) for kind, length in SHARED.findall(text))
