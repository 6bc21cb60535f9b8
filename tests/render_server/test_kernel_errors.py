"""What does not fit a kernel: one sentence names the kernel and the name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import BindingError
from deltalight.render_server.gpu.textures import texture_2d
from deltalight.render_server.gpu.uniform_block import (
    Block,
    Float,
    UniformBlock,
    Vec4,
)
from tests.render_server.tiny_kernel import CameraBlock, MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")

PARTS = (
    "uniform sampler2D picture; uniform sampler3D voxels; layout(rgba16f) writeonly uniform image2D filled;\n"
    "layout(std430) readonly buffer From { float from[]; };\n"
    "layout(std140) uniform Camera { vec4 pinhole; float z; };\n"
    "uniform vec3 tint; uniform int count; uniform mat4 turn; uniform usampler2D code;"
)
USES = (
    "vec4 sum = texelFetch(picture, ivec2(0), 0) + texelFetch(voxels, ivec3(0), 0) + from[0] + pinhole * z;\n"
    "sum += turn * vec4(tint, float(count)) + vec4(texelFetch(code, ivec2(0), 0));\n"
    "imageStore(filled, ivec2(0), sum); values[0] = sum.x;"
)


@dataclass(frozen=True, eq=False)
class LongerBlock(Block):
    pinhole: Vec4
    z: Vec4
    more: Float


@pytest.fixture
def given(gpu: GpuContext, out: moderngl.Buffer, texture: moderngl.Texture) -> Iterator[dict[str, Any]]:
    """What kernel `tiny` of PARTS and USES needs."""
    block = UniformBlock(gpu, CameraBlock((1, 2, 3, 4), 5.0))
    filled = texture_2d(gpu, (4, 4), 4, "f2")
    yield {
        "picture": texture,
        "voxels": None,
        "filled": filled,
        "From": None,
        "Camera": block,
        "tint": (0.0, 0.0, 0.0),
        "count": 1,
        "turn": np.eye(4),
        "code": None,
        "Out": out,
    }
    block.release()
    filled.release()


def test_what_all_errors_below_differ_from_runs(
    make: MakeKernel, given: dict[str, Any], out: moderngl.Buffer
) -> None:
    make(PARTS, USES).run((1,), **given)
    assert floats(out, 1) == [6]


@pytest.mark.parametrize("name", ["picture", "filled", "From", "Out", "Camera", "tint"])
def test_a_missing_name_is_told(make: MakeKernel, given: dict[str, Any], name: str) -> None:
    kernel = make(PARTS, USES, REAL=1)
    del given[name]
    with pytest.raises(BindingError, match=f"Kernel tiny REAL needs `{name}`, which it was not given"):
        kernel.run((1,), given)


@pytest.mark.parametrize(("name", "nearest"), [("pictures", "picture"), ("from", "From"), ("tints", "tint")])
def test_an_unknown_name_is_told_with_the_nearest(
    make: MakeKernel, given: dict[str, Any], name: str, nearest: str
) -> None:
    kernel = make(PARTS, USES)
    with pytest.raises(
        BindingError, match=f"Kernel tiny declares no `{name}`; the nearest name is `{nearest}`"
    ):
        kernel.run((1,), given, **{name: None})


def test_an_unknown_name_that_nothing_resembles_is_told(make: MakeKernel, given: dict[str, Any]) -> None:
    with pytest.raises(BindingError, match=r"Kernel tiny declares no `xyzzy`\.$"):
        make(PARTS, USES).run((1,), given, xyzzy=1)


@pytest.mark.parametrize("name", ["picture", "filled", "Out", "Camera"])
def test_what_was_released_is_not_bound_though_it_was_before(
    gpu: GpuContext, make: MakeKernel, given: dict[str, Any], name: str
) -> None:
    """OpenGL gives its name to what is made next, which the kernel would read or overwrite instead."""
    kernel = make(PARTS, USES)
    makers: dict[str, Callable[[], moderngl.Texture | moderngl.Buffer | UniformBlock[CameraBlock]]] = {
        "picture": lambda: gpu.ctx.texture((4, 4), 4, dtype="f4"),
        "filled": lambda: texture_2d(gpu, (4, 4), 4, "f2"),
        "Out": lambda: gpu.ctx.buffer(reserve=16),
        "Camera": lambda: UniformBlock(gpu, CameraBlock((1, 2, 3, 4), 5.0)),
    }
    mine = makers[name]()
    kernel.run((1,), {**given, name: mine})
    mine.release()
    with pytest.raises(BindingError, match=f"Kernel tiny: `{name}` was released; bind what replaces it"):
        kernel.run((1,), {**given, name: mine})
    kernel.run((1,), given)


WRONG_KINDS = [
    ("picture", lambda gpu: gpu.ctx.buffer(reserve=16), "a Texture that is sampled, not a Buffer"),
    ("picture", lambda gpu: gpu.ctx.texture3d((1, 1, 1), 4), "a Texture that is sampled, not a Texture3D"),
    ("voxels", lambda gpu: gpu.ctx.texture((1, 1), 4), "a Texture3D that is sampled, not a Texture"),
    (
        "voxels",
        lambda gpu: gpu.ctx.texture_array((1, 1, 1), 4),
        "a Texture3D that is sampled, not a TextureArray",
    ),
    ("voxels", lambda _: 3, "a Texture3D that is sampled, not a int"),
    ("filled", lambda _: None, "a Texture that is written or read texel by texel, not a NoneType"),
    ("filled", lambda gpu: gpu.ctx.texture3d((1, 1, 1), 4), "a Texture that is written .*, not a Texture3D"),
    ("From", lambda gpu: gpu.ctx.texture((1, 1), 4), "a storage buffer, not a Texture"),
    ("From", lambda _: np.zeros(4), "a storage buffer, not a ndarray"),
    ("Camera", lambda gpu: gpu.ctx.buffer(reserve=32), "a uniform block, not a Buffer"),
    ("Camera", lambda _: None, "a uniform block, not a NoneType"),
    ("tint", lambda gpu: gpu.ctx.texture((1, 1), 4), "a uniform, not a Texture"),
    ("tint", lambda _: None, "a uniform, not a NoneType"),
    ("tint", lambda _: "red", "a uniform, not a str"),
]


@pytest.mark.parametrize("wrong", WRONG_KINDS)
def test_a_wrong_kind_is_told(
    gpu: GpuContext,
    make: MakeKernel,
    given: dict[str, Any],
    wrong: tuple[str, Callable[[GpuContext], Any], str],
) -> None:
    name, value, said = wrong
    item = value(gpu)
    kernel = make(PARTS, USES)
    with pytest.raises(BindingError, match=f"Kernel tiny: `{name}` is {said}"):
        kernel.run((1,), {**given, name: item})
    if hasattr(item, "release"):
        item.release()


@pytest.mark.parametrize(
    "wrong",
    [("picture", "u1", "f"), ("code", "f1", "u"), ("code", "i4", "u")],
    ids="-".join,
)
def test_texels_of_a_type_that_the_sampler_cannot_read_are_told(
    gpu: GpuContext, make: MakeKernel, given: dict[str, Any], wrong: tuple[str, str, str]
) -> None:
    """OpenGL leaves undefined what such a look-up gives."""
    name, dtype, texels = wrong
    texture = texture_2d(gpu, (1, 1), 4, dtype)
    with pytest.raises(
        BindingError, match=f"Kernel tiny: `{name}` samples texels of type {texels}, not {dtype}"
    ):
        make(PARTS, USES).run((1,), {**given, name: texture})
    texture.release()


@pytest.mark.parametrize(
    "wrong",
    [(4, "f4", "rgba32f"), (1, "f2", "r16f"), (3, "f2", "no image format")],
    ids=lambda wrong: wrong[2],
)
def test_a_wrong_image_format_is_told(
    gpu: GpuContext, make: MakeKernel, given: dict[str, Any], wrong: tuple[int, str, str]
) -> None:
    components, dtype, found = wrong
    texture = texture_2d(gpu, (4, 4), components, dtype)
    with pytest.raises(
        BindingError, match=f"Kernel tiny: `filled` is declared rgba16f, but the texture is {found}"
    ):
        make(PARTS, USES).run((1,), {**given, "filled": texture})
    texture.release()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tint", (1.0, 2.0)),
        ("tint", 1.0),
        ("tint", np.zeros(2)),
        ("tint", ("a", "b", "c")),
        ("count", 1.5),
        ("count", (1, 2)),
        ("turn", np.eye(3)),
    ],
)
def test_a_value_that_a_uniform_cannot_take_is_told(
    make: MakeKernel,
    given: dict[str, Any],
    out: moderngl.Buffer,
    name: str,
    value: Any,  # noqa: ANN401 - wrong
) -> None:
    kernel = make(PARTS, USES)
    kernel.run((1,), given)
    with pytest.raises(BindingError, match=f"Kernel tiny: `{name}` cannot take "):
        kernel.run((1,), {**given, name: value})
    kernel.run((1,), given)
    assert floats(out, 1) == [6]


def test_a_uniform_block_of_the_wrong_size_is_told(
    gpu: GpuContext, make: MakeKernel, given: dict[str, Any]
) -> None:
    wrong = UniformBlock(gpu, LongerBlock((1, 2, 3, 4), (1, 1, 1, 1), 1.0))
    with pytest.raises(
        BindingError, match=r"Kernel tiny: block `Camera` takes (20|32) bytes, LongerBlock packs 48"
    ):
        make(PARTS, USES).run((1,), {**given, "Camera": wrong})
    wrong.release()
