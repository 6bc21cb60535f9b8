"""Kernels: textures, images, buffers, uniforms and blocks are bound by their names."""

import importlib
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu import kernel as kernel_module
from deltalight.render_server.gpu import raster_kernel
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import BindingError, Dispatch, watched
from deltalight.render_server.gpu.program_slots import Value
from deltalight.render_server.gpu.raster_kernel import RasterKernel
from deltalight.render_server.gpu.shader_source import SHADERS
from deltalight.render_server.gpu.textures import release_target, texture_2d
from deltalight.render_server.gpu.uniform_block import (
    STD140,
    Block,
    Bool,
    Float,
    Int,
    Mat4,
    UniformBlock,
    Vec2,
    Vec3,
    Vec4,
)
from tests.render_server.tiny_kernel import CameraBlock, MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")
# By name


def test_everything_is_bound_by_its_name(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture
) -> None:
    kernel = make(
        "layout(std430) readonly buffer First { float first[]; };\n"
        "layout(std430) readonly buffer Second { float second[]; };\n"
        "uniform sampler2D seen; uniform usampler2D codes; uniform isampler2D places;\n"
        "uniform sampler2DArray layers; uniform float scale;",
        "values[0] = first[0]; values[1] = second[0]; values[2] = scale * texelFetch(seen, ivec2(1), 0).r;\n"
        "values[3] = float(texelFetch(codes, ivec2(0), 0).r); values[4] = float(texelFetch(places, ivec2(0), 0).r);\n"
        "values[5] = texelFetch(layers, ivec3(0, 0, 1), 0).r;",
    )
    codes = texture_2d(gpu, (1, 1), 4, "u1", data=bytes([200, 0, 0, 0]))
    places = texture_2d(gpu, (1, 1), 4, "i2", data=np.array([-7, 0, 0, 0], np.int16).tobytes())
    layers = gpu.ctx.texture_array((1, 1, 2), 1, np.array([3, 4], np.float32).tobytes(), dtype="f4")
    first, second = (gpu.ctx.buffer(np.array([value], np.float32).tobytes()) for value in (11, 12))
    kernel.run(
        (1,),
        Second=second,
        Out=out,
        layers=layers,
        First=first,
        places=places,
        codes=codes,
        scale=2.5,
        seen=texture,
    )
    assert floats(out, 6) == [11, 12, 2.5, 200, -7, 4]
    assert {kind: sorted(names) for kind, names in kernel.resources().items()} == {
        "samplers": ["codes", "layers", "places", "seen"],
        "images": [],
        "storage blocks": ["First", "Out", "Second"],
        "uniform blocks": [],
    }
    for item in (codes, places, layers, first, second):
        item.release()


def test_own_bindings_come_before_shared_ones_and_shared_ones_in_their_order(
    make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make("uniform float a, b, c;", "values[0] = a; values[1] = b; values[2] = c;")
    kernel.run((1,), {"b": 2, "c": 2, "not mine": 0}, {"a": 3, "b": 3, "c": 3}, Out=out, c=1)
    assert floats(out, 3) == [3, 2, 1]


def test_textures_that_take_turns_are_checked_once_each_and_others_still(
    gpu: GpuContext,
    make: MakeKernel,
    out: moderngl.Buffer,
    texture: moderngl.Texture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As those of a room's cameras do."""
    checked: list[object] = []
    check = kernel_module.Program._check_sampled

    def noted(program: Any, slot: Any, item: object) -> None:  # noqa: ANN401 (not public)
        checked.append(item)
        check(program, slot, item)

    monkeypatch.setattr(kernel_module.Program, "_check_sampled", noted)
    kernel = make("uniform sampler2D seen;", "values[0] = texelFetch(seen, ivec2(0), 0).r;")
    other = texture_2d(gpu, (1, 1), 1, "f4", data=np.array([7], np.float32).tobytes())
    codes = texture_2d(gpu, (1, 1), 4, "u1")
    found = []
    for item in (texture, other, texture, other):
        kernel.run((1,), Out=out, seen=item)
        found += floats(out, 1)
    assert found == [1, 7, 1, 7]
    assert checked == [texture, other]
    with pytest.raises(BindingError, match="samples texels of type f"):
        kernel.run((1,), Out=out, seen=codes)
    other.release()
    codes.release()


def test_what_a_variant_leaves_out_may_be_given(make: MakeKernel, out: moderngl.Buffer) -> None:
    kernel = make("#ifdef MORE\nuniform sampler2D extra;\n#endif\nuniform float unused;", "values[0] = 1.0;")
    kernel.run((1,), Out=out, extra=None, unused=2.0)
    assert floats(out, 1) == [1]


def test_enough_workgroups_run_for_the_threads(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    statement = "if (gl_GlobalInvocationID == uvec3(0)) values[0] = float(gl_NumWorkGroups.x * 100u"
    statement += " + gl_NumWorkGroups.y * 10u + gl_NumWorkGroups.z);"
    kernel = make("", statement, "local_size_x = 1, local_size_y = 2, local_size_z = 8")
    seen: list[Dispatch] = []
    with watched(gpu, seen.append):
        for threads, groups in (((5, 3, 9), [5, 2, 2]), ((1, 2), [1, 1, 1]), ((0,), [1, 1, 1])):
            kernel.run(threads, Out=out)
            assert floats(out, 1) == [groups[0] * 100 + groups[1] * 10 + groups[2]]
            assert (seen[-1].kernel, seen[-1].size) == ("tiny", tuple(groups))
    kernel.run((1,), Out=out)
    assert len(seen) == 3


def test_watchers_are_told_what_may_have_been_written(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture
) -> None:
    kernel = make(
        "layout(std430) readonly buffer From { float from[]; };\n"
        "layout(std430) buffer Spare { float spare[]; };\n"
        "layout(rgba16f) readonly uniform image2D read_only; layout(rgba16f) writeonly uniform image2D filled;",
        "imageStore(filled, ivec2(0), imageLoad(read_only, ivec2(0)) + from[0]); values[0] = 1.0; spare[0] = 1.0;",
    )
    target = texture_2d(gpu, (4, 4), 4, "f2")
    seen: list[Dispatch] = []
    with watched(gpu, seen.append):
        kernel.run((1,), From=None, Spare=None, Out=out, read_only=texture, filled=target)
    assert seen[0].written == {"Out": out, "filled": target}
    assert gpu.watchers == []
    target.release()


@pytest.mark.parametrize(
    ("declared", "read"),
    [
        ("uniform sampler2D seen;", "textureLod(seen, vec2(0.5), 0).r"),
        ("layout(r32f) uniform image2D seen;", "imageLoad(seen, ivec2(0)).r"),
    ],
    ids=["sampled", "image"],
)
def test_what_is_cleared_between_runs_is_read(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, declared: str, read: str
) -> None:
    """llvmpipe puts clears and draws off until a barrier ends them, if what they change was bound before."""
    kernel = make(declared, f"values[0] = {read};")
    seen = texture_2d(gpu, (1, 1), 1, "f4", data=np.float32(1).tobytes())
    target = gpu.ctx.framebuffer([seen])
    target.use()
    for value in (1, 5, 6):
        target.clear(value)
        kernel.run((1,), Out=out, seen=seen)
        assert floats(out, 1) == [value]
    release_target(target)
    seen.release()


# None


def test_none_is_empty(make: MakeKernel, out: moderngl.Buffer) -> None:
    kernel = make(
        "uniform sampler2D a; uniform usampler2D b; uniform isampler2D c; uniform sampler3D d;\n"
        "uniform sampler2DArray e; layout(std430) readonly buffer From { float from[]; };",
        "ivec3 o = ivec3(0);\n"
        "values[0] = texelFetch(a, o.xy, 0).a + float(texelFetch(b, o.xy, 0).r + uint(texelFetch(c, o.xy, 0).r))"
        " + texelFetch(d, o, 0).r + texelFetch(e, o, 0).r + from[3];",
    )
    out.write(np.array([7], np.float32).tobytes())
    kernel.run((1,), a=None, b=None, c=None, d=None, e=None, From=None, Out=out)
    assert floats(out, 1) == [0]


def test_what_is_written_to_none_is_lost(make: MakeKernel, out: moderngl.Buffer) -> None:
    write = make("layout(std430) buffer To { float to[]; };", "to[0] = 3.0; values[0] = 1.0;")
    write.run((1,), To=None, Out=out)
    read = make("layout(std430) readonly buffer From { float from[]; };", "values[0] = from[0];")
    read.run((1,), From=None, Out=out)
    assert floats(out, 1) == [0]


# Images


def test_several_3d_images_have_units_of_their_own(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make(
        "layout(r32f) writeonly uniform image3D one; layout(r32f) writeonly uniform image3D two;\n"
        "layout(r32f) uniform image3D three; uniform sampler3D sampled;",
        "imageStore(one, ivec3(0), vec4(1.0)); imageStore(two, ivec3(0), vec4(2.0));\n"
        "imageStore(three, ivec3(0), imageLoad(three, ivec3(0)) + texelFetch(sampled, ivec3(0), 0));",
    )
    values = {"one": 10, "two": 20, "three": 30, "sampled": 40}
    textures = {
        name: gpu.ctx.texture3d((1, 1, 1), 1, np.array([value], np.float32).tobytes(), dtype="f4")
        for name, value in values.items()
    }
    kernel.run((1,), textures, Out=out)
    found = {name: float(np.frombuffer(item.read(), np.float32)[0]) for name, item in textures.items()}
    assert found == {"one": 1, "two": 2, "three": 70, "sampled": 40}
    for item in textures.values():
        item.release()


# Uniforms


UNIFORMS = "uniform float a; uniform int b; uniform bool c; uniform vec3 d; uniform ivec2 e; uniform mat4 m;"
UNIFORMS += " uniform uint f;"
STORES = (
    "values[0] = a; values[1] = float(b); values[2] = float(c); values[3] = d.z; values[4] = float(e.y);\n"
    "vec4 p = m * vec4(0.0, 0.0, 0.0, 1.0); values[5] = p.x; values[6] = p.y; values[7] = float(f);"
)


def turned(x: float, y: float) -> np.ndarray:
    """Row-major: the last column is the translation."""
    matrix = np.eye(4)
    matrix[:2, 3] = x, y
    return matrix


FIRST: dict[str, Value] = {
    "a": 0.5,
    "b": -3,
    "c": True,
    "d": (1, 2, 3),
    "e": (4, 8),
    "m": turned(5, 6),
    "f": 7,
}
SECOND: dict[str, Value] = {
    "a": np.float32(1.5),
    "b": np.int64(4),
    "c": np.bool_(False),
    "d": np.array([7, 8, 9]),
    "e": [1, -2],
    "m": turned(7, 8).astype(np.float32),
    "f": 8,
}


def test_uniforms_take_plain_and_numpy_values_and_change(make: MakeKernel, out: moderngl.Buffer) -> None:
    kernel = make(UNIFORMS, STORES)
    first, second = [0.5, -3, 1, 3, 8, 5, 6, 7], [1.5, 4, 0, 9, -2, 7, 8, 8]
    for given, expected in ((FIRST, first), (SECOND, second), (FIRST, first)):
        kernel.run((1,), given, Out=out)
        assert floats(out, 8) == expected


def test_only_values_that_changed_are_written(
    make: MakeKernel, out: moderngl.Buffer, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = make(UNIFORMS, STORES)
    written: list[str] = []
    write = moderngl.Uniform.write

    def write_bytes(uniform: moderngl.Uniform, data: bytes) -> None:
        written.append(uniform.name)
        write(uniform, data)

    monkeypatch.setattr(moderngl.Uniform, "write", write_bytes)  # which setting a value calls, too

    def names_written(**changes: Value) -> list[str]:
        written.clear()
        kernel.run((1,), {**FIRST, **changes}, Out=out)
        return sorted(written)

    assert names_written() == sorted(FIRST)
    assert names_written(m=turned(5, 6)) == []
    assert names_written(a=0.25, m=turned(5, 7)) == ["a", "m"]
    assert names_written() == ["a", "m"]


# Uniform blocks


@dataclass(frozen=True, eq=False)
class EveryTypeBlock(Block):
    """Each type behind one that leaves it unaligned, where there is one."""

    first: Float
    pair: Vec2
    flag: Bool
    triple: Vec3
    behind_triple: Float
    number: Int
    four: Vec4
    before_matrix: Vec3
    matrix: Mat4
    last_pair: Vec2
    off: Bool
    negative: Int
    last_triple: Vec3


EVERY_TYPE = EveryTypeBlock(
    first=1.5,
    pair=(2, 3),
    flag=True,
    triple=(4, 5, 6),
    behind_triple=7,
    number=8,
    four=(9, 10, 11, 12),
    before_matrix=np.array([13.0, 14.0, 15.0]),
    matrix=np.arange(16.0).reshape(4, 4) + 100,
    last_pair=(16, 17),
    off=False,
    negative=-18,
    last_triple=(19, 20, 21),
)
LENGTHS = {"vec2": 2, "vec3": 3, "vec4": 4}


def reader_of(block: type[Block]) -> tuple[str, str, int]:
    """GLSL that copies each member of `Tested` into `values`, row by row: declaration, statements, floats."""
    lines, at = [], 0
    for name, kind in block.members():
        if kind == "mat4":
            lines += [
                f"values[{at + 4 * row + col}] = {name}[{col}][{row}];"
                for row in range(4)
                for col in range(4)
            ]
            at += 16
        else:
            length = LENGTHS.get(kind, 1)
            parts = [f"{name}[{i}]" for i in range(length)] if length > 1 else [name]
            lines += [f"values[{at + i}] = float({part});" for i, part in enumerate(parts)]
            at += length
    body = " ".join(f"{kind} {name};" for name, kind in block.members())
    return f"layout(std140) uniform Tested {{ {body} }};", "\n".join(lines), at


def test_every_member_of_a_block_arrives(gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer) -> None:
    assert {kind for _, kind in EveryTypeBlock.members()} == set(STD140)
    declared, statements, count = reader_of(EveryTypeBlock)
    kernel = make(declared, statements)
    block = UniformBlock(gpu, EVERY_TYPE)
    kernel.run((1,), Tested=block, Out=out)
    given = [np.ravel(getattr(EVERY_TYPE, item.name)) for item in fields(EVERY_TYPE)]
    assert floats(out, count) == list(np.concatenate(given).astype(float))
    block.release()


def test_a_block_is_rewritten_when_its_value_changes(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make(
        "layout(std140) uniform Camera { vec4 pinhole; float z; };", "values[0] = pinhole.y; values[1] = z;"
    )
    block = UniformBlock(gpu, CameraBlock((1, 2, 3, 4), 5.0))
    for value in (
        CameraBlock((1, 2, 3, 4), 5.0),
        CameraBlock((1, 6, 3, 4), 7.0),
        CameraBlock((1, 2, 3, 4), 5.0),
    ):
        block.write(value)
        kernel.run((1,), Camera=block, Out=out)
        assert floats(out, 2) == [value.pinhole[1], value.z]
        assert block.value is value
    block.release()


BLOCK_DECLARATION = re.compile(r"layout\s*\(std140\)\s*uniform\s+(\w+)\s*\{([^}]*)\}", re.DOTALL)
MEMBER = re.compile(r"(\w+)\s+(\w+)\s*;")


def blocks_of_the_project() -> dict[str, type[Block]]:
    """The dataclasses of uniform blocks, by the name that the block has in GLSL."""
    for path in SHADERS.parents[1].rglob("*.py"):
        if "(Block):" in path.read_text():
            module = ".".join(path.relative_to(SHADERS.parents[2]).with_suffix("").parts)
            importlib.import_module(f"deltalight.{module}")
    ours = [
        block for block in Block.__subclasses__() if block.__module__.startswith("deltalight.render_server.")
    ]
    return {block.__name__.removesuffix("Block"): block for block in ours}


def test_every_block_is_declared_once_in_glsl_and_once_in_python() -> None:
    """With the same members in the same order and of the same types."""
    texts = {path: re.sub(r"//[^\n]*", "", path.read_text()) for path in SHADERS.rglob("*.glsl")}
    declared = [found for text in texts.values() for found in BLOCK_DECLARATION.findall(text)]
    names = [name for name, _ in declared]
    blocks = blocks_of_the_project()
    assert sorted(names) == sorted(blocks)
    for name, body in declared:
        members = tuple((member, kind) for kind, member in MEMBER.findall(body))
        assert members == blocks[name].members(), name


# Raster kernels

VERTEX = "in vec2 place; uniform float z; void main() { gl_Position = vec4(place, z, 1.0); }"
FRAGMENT = "uniform vec4 tint; uniform sampler2D seen; out vec4 color;"
FRAGMENT += " void main() { color = tint + texelFetch(seen, ivec2(0), 0); }"


class Triangle:
    """Covers the whole target."""

    triangle_count = 1

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._places = gpu.ctx.buffer(np.array([-1, -1, 3, -1, -1, 3], np.float32).tobytes())

    def draw(self, program: moderngl.Program) -> None:
        array = self._gpu.ctx.vertex_array(program, [(self._places, "2f", "place")])
        array.render()
        array.release()


def test_a_raster_kernel_binds_by_name_too(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, texture: moderngl.Texture
) -> None:
    monkeypatch.setattr(raster_kernel, "SHADERS", tmp_path)
    for stage, text in (("vert", VERTEX), ("frag", FRAGMENT)):
        (tmp_path / f"tiny.{stage}.glsl").write_text(text)
    kernel, triangle = RasterKernel(gpu, "tiny"), Triangle(gpu)
    color = texture_2d(gpu, (4, 2), 4, "f4")
    target = gpu.ctx.framebuffer([color], gpu.ctx.depth_renderbuffer((4, 2)))
    target.use()
    target.clear()
    seen: list[Dispatch] = []
    with watched(gpu, seen.append):
        kernel.draw(target, triangle, {"z": 0.5, "seen": texture}, box=(1, 0, 2, 1), tint=(1, 2, 3, 4))
    drawn = np.frombuffer(color.read(), np.float32).reshape(2, 4, 4)
    expected = np.zeros((2, 4, 4))
    expected[0, 1:3] = (2, 3, 4, 5)
    assert np.array_equal(drawn, expected)
    assert [(item.kernel, item.size) for item in seen] == [("tiny", (1,))]
    assert color in seen[0].written.values()
    with pytest.raises(BindingError, match="Kernel tiny needs `z`"):
        kernel.draw(target, triangle, seen=texture, tint=(1, 2, 3, 4))
    with pytest.raises(BindingError, match="Kernel tiny declares no `tin`; the nearest name is `tint`"):
        kernel.draw(target, triangle, tin=0)
    gpu.ctx.detect_framebuffer(0).use()
    target.release()
    color.release()
    kernel.release()
