"""Sources for software renderers: samplers and read-only storage buffers become images."""

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu import context as context_module
from deltalight.render_server.gpu.context import GpuContext, count_gl_objects
from deltalight.render_server.gpu.kernel import BindingError
from deltalight.render_server.gpu.texel_images import with_images
from deltalight.render_server.gpu.textures import texture_2d
from tests.render_server.tiny_kernel import MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")
MANY = 32
SAMPLERS = """#pragma texels r32f seen other
uniform sampler2D seen;
uniform sampler2D other;
"""


def test_fetches_of_named_samplers_become_loads() -> None:
    source = (
        SAMPLERS
        + "float x = texelFetch(seen, ivec2(texelFetch(seen, ivec2(0), 0).r, size(textureSize(seen, 0))), 0).r;"
    )
    found = with_images(source + " float y = texture(other, vec2(0)).r;", MANY)
    assert "layout(r32f) restrict readonly uniform image2D seen;" in found
    assert "imageLoad(seen, ivec2(imageLoad(seen, ivec2(0)).r, size(imageSize(seen))))" in found
    assert "uniform sampler2D other;" in found  # sampled


def test_images_beyond_the_devices_limit_stay_samplers() -> None:
    source = SAMPLERS + "float x = texelFetch(seen, ivec2(0), 0).r + texelFetch(other, ivec2(0), 0).r;\n"
    written = "layout(r32f) writeonly uniform image2D result;\n"
    assert "sampler" not in with_images(written + source, 3)
    assert "uniform sampler2D other;" in with_images(written + source, 2)
    assert with_images(written + source, 1) == written + source


def test_other_levels_are_refused() -> None:
    with pytest.raises(ValueError, match="`seen` has `#pragma texels`"):
        with_images(SAMPLERS + "float x = texelFetch(seen, ivec2(0), 1).r;", MANY)


def test_buffers_that_are_written_and_structs_of_other_members_stay() -> None:
    blocks = (
        "struct Mixed { vec4 a; int b; };\n"
        "#define ACCESS\n"
        "layout(std430) readonly buffer Kept { Mixed kept[]; };\n"
        "layout(std430) ACCESS buffer Written { uint written[]; };\n"
        "#ifdef NEVER\nlayout(std430) readonly buffer Written { uint written[]; };\n#endif\n"
    )
    source = blocks + "void main() { written[0] = uint(kept[0].b); }"
    assert with_images(source, MANY) == source


@pytest.mark.parametrize(
    ("declared", "layout"),
    [
        ("struct Entry { vec4 a, b; };", "std430"),
        ("const int N = 2;\nstruct Entry { vec4 a[N]; vec4 b; };", "std430"),
        ("struct Entry { mat4 a; };", "std430"),
        ("struct Entry { vec4 a; };", "std430, binding = 3"),
    ],
    ids=["two names", "named length", "matrix", "another layout"],
)
def test_declarations_of_other_forms_stay_whole(declared: str, layout: str) -> None:
    """A plugin's shader may have them: read in a wrong layout, they would be wrong in silence."""
    block = f"layout({layout}) readonly buffer Entries {{ Entry entries[]; }};\n"
    source = (
        f"layout(std430) buffer Out {{ vec4 result; }};\n{declared}\n{block}void main() {{ entries[0]; }}"
    )
    assert with_images(source, MANY) == source


def test_every_kind_of_array_is_read_as_from_its_buffer(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    """Numbers before an array, structs in structs, nested indices, lengths."""
    kernel = make(
        "struct Inner { vec4 a; };\n"
        "struct Entry { vec4 a; Inner inner[2]; };\n"
        "#define ACCESS readonly\n"
        "layout(std430) ACCESS buffer Entries { uint entry_count; Entry entries[]; };\n"
        "layout(std430) readonly buffer Places { uint place_count; uint places[]; };   // of entries\n"
        "layout(std430) readonly buffer Pairs { uint pair_count; uint unused; uvec2 pairs[]; };\n"
        "layout(std430) readonly buffer Ints { int ints[]; };\n"
        "layout(std430) readonly buffer Reals { float reals[]; };\n"
        "layout(std430) readonly buffer Twos { vec2 twos[]; };",
        "values[0] = entries[places[1]].inner[1].a.z; values[1] = float(entry_count);\n"
        "values[2] = float(entries.length()); values[3] = float(place_count + places[places[0]]);\n"
        "values[4] = float(pair_count) + float(pairs[1].y); values[5] = float(ints[1]); values[6] = reals[2];\n"
        "values[7] = twos[1].y; values[8] = float(ints.length()); values[9] = entries[0].a.x;",
    )
    entries = np.arange(28, dtype=np.float32)
    entries[0] = np.array([9], np.uint32).view(np.float32)[0]
    contents = {
        "Entries": entries,
        "Places": np.array([5, 0, 1, 7], np.uint32),
        "Pairs": np.array([3, 0, 1, 2, 4, 8], np.uint32),
        "Ints": np.array([1, -7, 3], np.int32),
        "Reals": np.array([0, 1, 2.5], np.float32),
        "Twos": np.array([1, 2, 3, 4.5], np.float32),
    }
    buffers = {name: gpu.ctx.buffer(data.tobytes()) for name, data in contents.items()}
    kernel.run((1,), Out=out, **buffers)
    assert floats(out, 10) == [26, 9, 2, 5, 11, -7, 2.5, 4.5, 3, 4]
    assert sorted(kernel.resources()["storage blocks"]) == sorted([*buffers, "Out"])
    for buffer in buffers.values():
        buffer.release()


def test_a_buffer_that_grows_or_takes_the_place_of_another_is_read_anew(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make(
        "layout(std430) readonly buffer Reals { float reals[]; };", "values[0] = reals[reals.length() - 1];"
    )

    def last(buffer: moderngl.Buffer | None) -> float:
        kernel.run((1,), Out=out, Reals=buffer)
        return floats(out, 1)[0]

    first = gpu.ctx.buffer(np.array([1, 2], np.float32).tobytes())
    assert last(first) == 2
    first.orphan(12)
    first.write(np.array([1, 2, 3], np.float32).tobytes())
    assert last(first) == 3
    first.release()
    second = gpu.ctx.buffer(np.array([7, 8, 9], np.float32).tobytes())  # perhaps under the first one's number
    assert last(second) == 9
    assert last(None) == 0
    with pytest.raises(BindingError, match="`Reals` is a storage buffer, not a int"):
        kernel.run((1,), Out=out, Reals=5)
    second.release()


def test_a_sampler_that_became_an_image_takes_none_and_refuses_other_formats(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    if not gpu.is_software:
        pytest.skip("only software renderers load from images what shaders fetch from samplers")
    kernel = make(
        "#pragma texels r32f seen\nuniform sampler2D seen;",
        "values[0] = texelFetch(seen, ivec2(0), 0).r + 1.0;",
    )
    kernel.run((1,), Out=out, seen=None)
    assert floats(out, 1) == [1]
    half = texture_2d(gpu, (1, 1), 1, "f2")
    with pytest.raises(BindingError, match="`seen` is declared r32f, but the texture is r16f"):
        kernel.run((1,), Out=out, seen=half)
    half.release()


def test_programs_free_the_textures_through_which_they_read_buffers(
    gpu: GpuContext, make: MakeKernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not gpu.is_software:
        pytest.skip("only software renderers read storage buffers as images")
    monkeypatch.setattr(gpu.programs, "_programs", {})
    monkeypatch.setattr(context_module, "SPARE_PROGRAMS", 0)
    kernel = make("layout(std430) readonly buffer Reals { float reals[]; };", "values[0] = reals[0];")
    kernel.run((1,), Out=None, Reals=None)
    assert kernel._programs[()]._shown["Reals"]._name
    held = count_gl_objects()["Texture"]
    kernel.release()
    assert count_gl_objects()["Texture"] == held - 1


@pytest.mark.parametrize("divisor", [1, 2, 3, 5, 7, 16, 63, 64, 100, 640, 1279, 3840])
def test_quotients_by_floats_are_those_of_integers(make: MakeKernel, gpu: GpuContext, divisor: int) -> None:
    """Around multiples, where rounding would show, up to the pixels of 4K and the voxels of 512 an edge."""
    top = min(divisor << 21, 512**3)
    some = np.linspace(0, top // divisor, 40, dtype=int) * divisor
    dividends = np.unique(np.clip([some - 1, some, some + divisor - 1], 0, top)).astype(np.int32)
    given, found = (gpu.ctx.buffer(dividends.tobytes()) for _ in range(2))
    kernel = make(
        "layout(std430) readonly buffer Given { int given[]; };\n"
        "layout(std430) writeonly buffer Found { int found[]; };\n"
        'uniform int divisor;\n#include "common/quotient.glsl"\n',
        "int i = int(gl_GlobalInvocationID.x); found[i] = quotient(given[i], divisor); values[0] = 0.0;",
    )
    kernel.run((len(dividends),), Out=gpu.discarded_buffer, Given=given, Found=found, divisor=divisor)
    assert np.array_equal(np.frombuffer(found.read(), np.int32), dividends // divisor)
    given.release()
    found.release()
