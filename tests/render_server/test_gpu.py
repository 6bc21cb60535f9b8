"""The ground floor of the renderer: shader text, uniforms, readback, timers, context errors, volumes."""

import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_method import DifferentialMethod, DvctMethod
from deltalight.render_server.gpu import shader_source as shader_text
from deltalight.render_server.gpu.context import (
    HIGHEST_NAME,
    NEEDED,
    GpuContext,
    check_limits,
    count_gl_objects,
    explain_context_failure,
    is_software_renderer,
    limits_of,
)
from deltalight.render_server.gpu.kernel import Kernel, ShaderError
from deltalight.render_server.gpu.textures import AsyncReadback, gpu_objects, sizes_bytes, texture_2d
from deltalight.render_server.methods.differential import SolutionVoxels
from deltalight.render_server.methods.dvct_paper import InjectedVoxels
from deltalight.render_server.methods.voxel_volumes import DeltaVoxels
from deltalight.render_server.passes.volumes import ABOVE_BORDERS, PlacedVolume, VolumePlacement, place_volume
from deltalight.render_server.passes.voxels import (
    LARGEST_ITEM_BYTES,
    LEAST_SURFELS,
    VoxelMipmap,
    VoxelStore,
    bounce_tail_bytes,
    memory_statement,
    mipmap_shape,
    volume_memory_bytes,
)
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import Stage, cube, directional, floor, frame

ROOT = Path(__file__).parents[2]
TEXELS = Path(__file__).with_name("mipmap_texels")
pytestmark = pytest.mark.usefixtures("clean_gl")


# Shader text


@pytest.fixture
def shaders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that includes are relative to."""
    monkeypatch.setattr(shader_text, "SHADERS", tmp_path)
    return tmp_path


def test_includes_are_recursive_and_come_once(shaders: Path) -> None:
    (shaders / "inner.glsl").write_text("float inner;")
    (shaders / "outer.glsl").write_text('#include "inner.glsl"\nfloat outer;')
    (shaders / "main.glsl").write_text('#include "outer.glsl"\n#include "inner.glsl"\nvoid main() {}')
    text = shader_text.shader_source(shaders / "main.glsl", {"SIZE": 3})
    lines = text.splitlines()
    assert lines[:2] == ["#version 430 core", "#define SIZE 3"]
    assert text.count("float inner;") == 1
    assert lines.index("float inner;") < lines.index("float outer;") < lines.index("void main() {}")


def test_defines_differ_as_their_texts_do(shaders: Path) -> None:
    (shaders / "main.glsl").write_text("void main() {}")
    for value in (1, 1.0, "1u"):
        text = shader_text.shader_source(shaders / "main.glsl", {"SIZE": value})
        assert text.splitlines()[1] == f"#define SIZE {value}"


def test_include_of_itself_ends(shaders: Path) -> None:
    (shaders / "main.glsl").write_text('#include "main.glsl"\nvoid main() {}')
    assert shader_text.shader_source(shaders / "main.glsl").count("void main()") == 1


def test_missing_include_is_named(shaders: Path) -> None:
    (shaders / "main.glsl").write_text('#include "nowhere.glsl"')
    with pytest.raises(FileNotFoundError, match=r"nowhere\.glsl"):
        shader_text.shader_source(shaders / "main.glsl")


@pytest.mark.parametrize("broken", ["main", "part"])
def test_compiler_errors_name_the_line_in_its_own_file(gpu: GpuContext, shaders: Path, broken: str) -> None:
    mistake = "float x = nonsense;"
    in_part, in_main = (mistake, "") if broken == "part" else ("", mistake)
    (shaders / "part.glsl").write_text(f"float one;\nfloat two;\n{in_part}\n")
    main = 'layout(local_size_x = 1) in;\n#include "part.glsl"\nvoid main() {\n' + in_main + "\n}"
    (shaders / "main.comp.glsl").write_text(main)
    with pytest.raises(ShaderError, match="Kernel main does not compile: ") as caught:
        Kernel(gpu, shaders / "main").run((1,))
    line = {"main": 4, "part": 3}[broken]
    assert re.search(rf"^\d+(:{line}\(|\({line}\) :)", str(caught.value), re.MULTILINE), (
        "Mesa's way, NVIDIA's way"
    )
    assert "// file 1: " in shader_text.shader_source(shaders / "main.comp.glsl")


# Uniforms and dispatch


UNIFORMS = """
layout(local_size_x = 4, local_size_y = 2) in;
layout(std430) buffer Out { vec4 values[]; };
uniform float a; uniform int b; uniform bool c; uniform vec3 d; uniform ivec2 e; uniform mat4 m;
uniform float removed;
void main() {
    if (gl_GlobalInvocationID.xy == uvec2(0)) {
        values[0] = vec4(a, float(b), float(c), d.z);
        values[1] = m * vec4(0.0, 0.0, 0.0, 1.0);
        values[2] = vec4(vec2(e), vec2(gl_NumWorkGroups.xy));
    }
}
"""


def test_uniforms_arrive_and_removed_ones_do_not_matter(gpu: GpuContext, tmp_path: Path) -> None:
    (tmp_path / "uniforms.comp.glsl").write_text(UNIFORMS)
    kernel = Kernel(gpu, tmp_path / "uniforms")
    out = gpu.ctx.buffer(reserve=48)
    matrix = np.eye(4)
    matrix[:3, 3] = (5, 6, 7)  # row-major: the last column is the translation
    others = {"unknown": 2.0}  # of what is shared, a kernel takes what it needs
    kernel.run(
        (9, 3), others, Out=out, a=0.5, b=-3, c=True, d=(1.0, 2.0, 3.0), e=(4, 8), m=matrix, removed=1.0
    )
    values = np.frombuffer(out.read(), np.float32)
    assert values.tolist() == [0.5, -3, 1, 3, 5, 6, 7, 1, 4, 8, 3, 2]
    out.release()
    kernel.release()


# Readback


def test_readback_gives_each_texture_once_and_in_order(gpu: GpuContext) -> None:
    rng = np.random.default_rng(0)
    reader = AsyncReadback(gpu)
    arrays: list[np.ndarray] = [
        rng.integers(0, 255, (7, 5, 4), dtype=np.uint8),
        rng.normal(size=(3, 9, 2)).astype(np.float16),
        rng.normal(size=(7, 5, 1)).astype(np.float32),
    ]
    kinds = ["u1", "f2", "f4"]
    textures = [
        texture_2d(gpu, array.shape[1::-1], array.shape[2], kind, data=array.tobytes())
        for array, kind in zip(arrays, kinds, strict=True)
    ]
    for _ in range(3):
        for texture, kind in zip(textures, kinds, strict=True):
            reader.push(texture, kind)
        assert len(reader) == 3
        for array in arrays:
            found = reader.pop()
            assert found.dtype == array.dtype
            assert np.array_equal(found, array)
    assert len(reader) == 0
    reader.release()
    for texture in textures:
        texture.release()


def test_what_was_read_back_is_as_old_as_the_push(gpu: GpuContext) -> None:
    reader = AsyncReadback(gpu)
    texture = texture_2d(gpu, (4, 4), 1, "u1", data=bytes([1] * 16))
    reader.push(texture, "u1")
    texture.write(bytes([2] * 16))
    reader.push(texture, "u1")
    assert [int(reader.pop().max()) for _ in range(2)] == [1, 2]
    reader.release()
    texture.release()


# Context errors


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("libGL.so not loaded", "libegl1 libgl1"),
        ("libEGL.so not loaded", "libegl1 libgl1"),
        ("eglInitialize failed (0x3001)", "libgl1-mesa-dri"),
        ("(standalone) XOpenDisplay: cannot open display", "EGL backend"),
        ("eglCreateContext failed (0x3009)", "update the graphics driver"),
        ("requested device index 0, but found 0 devices", "install libgl1-mesa-dri or the graphics driver"),
        ("requested device index 1, but found 1 devices", "no such GPU"),
        ("something new", "deltalight doctor"),
    ],
)
def test_context_failures_are_explained(text: str, hint: str) -> None:
    sentence = explain_context_failure(text)
    assert text in sentence
    assert hint in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("name", "software"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("SwiftShader Device", True),
        ("NVIDIA H100/PCIe/SSE2", False),
    ],
)
def test_software_renderers_are_known_by_name(name: str, software: bool) -> None:
    assert is_software_renderer(name) is software


CHILD = """
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_method import DifferentialMethod, DvctMethod
from deltalight.render_server.gpu.context import create_context
try:
    create_context(device=99)
except DeltalightError as error:
    print(error)
first = create_context()
if not first.is_software:
    print("--allow-software: not asked for")
else:
    first.release()
    try:
        create_context(allow_software=False)
    except DeltalightError as error:
        print(error)
"""


def test_unusable_contexts_are_refused() -> None:
    """In a process of its own: a second context would take the place of the tests' current one."""
    command = [sys.executable, "-c", CHILD]
    child = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert child.returncode == 0, child.stderr
    no_device, no_gpu = child.stdout.splitlines()
    assert "no such GPU" in no_device
    assert "--allow-software" in no_gpu


# Limits


def test_this_device_has_what_is_needed(gpu: GpuContext) -> None:
    limits = limits_of(gpu.ctx)
    assert set(limits) == set(NEEDED)
    check_limits(gpu.renderer_name, limits)


@pytest.mark.parametrize("name", NEEDED)
def test_a_device_that_lacks_something_is_refused_by_name_and_numbers(name: str) -> None:
    less = {**NEEDED, name: NEEDED[name] - 1}
    with pytest.raises(
        DeltalightError, match=rf"Old GPU has {name} {less[name]}, and {NEEDED[name]} is needed"
    ):
        check_limits("Old GPU", less)


def test_a_buffer_beyond_what_shaders_reach_is_refused(
    gpu: GpuContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(gpu.ctx.info, "GL_MAX_SHADER_STORAGE_BLOCK_SIZE", 100_000_000)
    gpu.check_storage(100_000_000, "nothing")
    with pytest.raises(DeltalightError, match=r"200 MB .* reach 100 MB .* lower method.volume_size"):
        gpu.storage_buffer(200_000_000, "method.volume_size")


def test_a_store_grows_up_to_what_a_buffer_holds_and_is_kept_where_that_is_too_little(
    gpu: GpuContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(gpu.ctx.info, "GL_MAX_SHADER_STORAGE_BLOCK_SIZE", 10_000 * LARGEST_ITEM_BYTES)
    store = VoxelStore(gpu, 32)
    store.reset(9_000)
    assert 9_000 <= store.surfel_capacity < 10_000
    with pytest.raises(DeltalightError, match="triangle_budget"):
        store.reset(10_001)
    assert store.counts() == (0, 0)
    store.release()


# Volumes


VOXELS = [
    (DeltaVoxels, DvctMethod(), 6, 32),
    (SolutionVoxels, DifferentialMethod(), 6, 32),
    (InjectedVoxels, None, 1, 0),
]


@pytest.mark.parametrize(("make", "settings", "directions", "far_size"), VOXELS)
def test_the_stated_memory_is_what_is_allocated(
    gpu: GpuContext,
    make: Any,  # noqa: ANN401
    settings: Any,  # noqa: ANN401
    directions: int,
    far_size: int,
) -> None:
    """But for surfels, of which there are none yet, and uniform blocks and the like."""
    size = 64
    voxels = make(gpu, size) if settings is None else make(gpu, settings, size)
    large = [item for item in set(gpu_objects(voxels)) if isinstance(item, moderngl.Texture3D)]
    sets = [voxels.real, voxels.objects, *([voxels.far._set] if far_size else [])]
    grids = [grid for each in sets for grid in (each.store.grid, each.groups._grid)]
    stated = 2 * volume_memory_bytes(size, directions) + volume_memory_bytes(far_size, 6)
    stated += bounce_tail_bytes() if directions == 6 else 0
    mipmaps = [each for each in vars(voxels).values() if isinstance(each, VoxelMipmap)]
    occupied = [each.occupied for each in (*mipmaps, *([voxels.far.mipmap] if far_size else []))]
    assert sum(sizes_bytes([*large, *grids, *occupied])) == stated
    assert f"{math.ceil(stated / 1e6)} MB" in memory_statement(size, directions, 4096, far_size)
    surfels = 3 * LEAST_SURFELS * 400  # bytes a surfel, with its slot, light and group
    assert sizes_bytes([voxels])[0] - stated < surfels
    voxels.release()


def test_a_volume_begins_empty(gpu: GpuContext) -> None:
    mipmap = VoxelMipmap(gpu, 40, 6)
    assert not np.frombuffer(mipmap.texture.read(), np.float16).any()
    mipmap.release()


def test_memory_beyond_the_budget_is_refused_with_both_numbers() -> None:
    grids = 512**3 * 4 + 6 * 256**3 * 4 + 4 * (513**2 * 17 + 10 * 257**2 * 9)
    needed = math.ceil(2 * (512 * 512 * (6 * 512 + 3 * 256) * 8 + grids) / 1e6)
    with pytest.raises(DeltalightError, match=rf"{needed} MB.*2048 MB.*volume_size"):
        memory_statement(512, 6, 2048)
    assert f"{needed} MB" in memory_statement(512, 6, needed)


def test_scene_beyond_the_budget_leaves_the_old_one_in_place(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    objects, lights = [stage.virtual(cube())], [directional()]
    small, large = (stage.document(objects, lights, floor(), volume_size=size) for size in (32, 512))
    renderer = SceneRenderer(gpu, small)
    before = renderer.render(frame()).color
    with pytest.raises(DeltalightError, match="MB"):
        renderer.set_scene(large)
    assert np.array_equal(renderer.render(frame()).color, before)
    renderer.release()


COORDINATE = st.floats(-50, 50)
EXTENT = st.floats(0.01, 5)


@given(
    st.tuples(COORDINATE, COORDINATE, COORDINATE),
    st.tuples(EXTENT, EXTENT, EXTENT),
    st.sampled_from([32, 40, 64, 256]),
    st.tuples(*[st.integers(-20, 20)] * 3),
)
def test_volume_holds_the_objects_and_moves_by_whole_voxels(
    corner: tuple[float, ...], extent: tuple[float, ...], size: int, steps: tuple[int, ...]
) -> None:
    low = np.array(corner, np.float64)
    high = low + np.array(extent)
    placed = place_volume(low, high, size, None)
    origin = np.array(placed.origin)
    assert placed.voxel_edge * size == pytest.approx(2 * (high - low).max())
    places = origin / placed.voxel_edge + ABOVE_BORDERS * size
    assert np.abs(places - np.round(places)).max() < 1e-6
    assert (origin <= low + 1e-9).all()
    assert (origin + placed.voxel_edge * size >= high - 1e-9).all()
    moved = place_volume(low + np.array(steps) * 0.37, high + np.array(steps) * 0.37, size, size * 0.1)
    shift = (np.array(moved.origin) - np.array(place_volume(low, high, size, size * 0.1).origin)) / 0.1
    assert np.abs(shift - np.round(shift)).max() < 1e-6
    assert np.abs(shift - 3.7 * np.array(steps)).max() <= 1 + 1e-6


@pytest.mark.parametrize("error", [0.0, 3e-5, -3e-5])
@pytest.mark.parametrize("size", [32, 64, 256])
def test_planes_at_whole_voxels_lie_in_the_voxels_above(size: int, error: float) -> None:
    """Of a box on the floor, whose height is a whole number of voxels, whatever its last bits are."""
    low, high = np.array([-0.05, 0.1, 0.0]), np.array([0.05, 0.2, 0.1])
    placed = place_volume(low, high, size, None)
    bounds = placed.voxel_bounds(np.stack([low, high]) + error * placed.voxel_edge)
    assert (-bounds[3:] - bounds[:3] == size // 2).all()
    floor = np.floor((error * placed.voxel_edge - placed.origin[2]) / placed.voxel_edge)
    assert bounds[2] == floor


def block(size: int, level: int, direction: int) -> tuple[slice, slice, slice]:
    """Where a level of a direction lies: (z, y, x) of the texture (shaders/common/volume.glsl)."""
    cells = size >> level
    x, y, z = 0, 0, direction * size
    if level > 0:
        x = (direction & 1) * size // 2
        y = size - (size >> (level - 1))
        z = 6 * size + (direction >> 1) * size // 2
    return slice(z, z + cells), slice(y, y + cells), slice(x, x + cells)


@pytest.mark.parametrize("size", [32, 40, 64, 72, 104, 256, 512])
def test_blocks_of_the_mipmap_do_not_overlap(size: int) -> None:
    shape = mipmap_shape(size, 6)[::-1]
    taken: list[tuple[slice, ...]] = []
    for level in range(VolumePlacement((0, 0, 0), 1.0, size).levels):
        for direction in range(6):
            own = block(size, level, direction)
            assert all(part.stop <= whole for part, whole in zip(own, shape, strict=True))
            for other in taken:
                apart = (a.stop <= b.start or b.stop <= a.start for a, b in zip(own, other, strict=True))
                assert any(apart), (level, direction)
            taken.append(own)


@pytest.fixture(scope="module")
def kernels(gpu: GpuContext) -> Iterator[tuple[Kernel, Kernel]]:
    made = Kernel(gpu, TEXELS, PAINT=1), Kernel(gpu, TEXELS)
    yield made
    for kernel in made:
        kernel.release()


@pytest.mark.parametrize("size", [32, 40])
def test_shaders_lay_out_and_look_up_the_mipmap_so(
    gpu: GpuContext, kernels: tuple[Kernel, Kernel], size: int
) -> None:
    """Every block painted with its own number is where Python expects it, and a look-up anywhere in the volume,
    up to its borders, meets that number alone."""
    paint, look_up = kernels
    placement = VolumePlacement((0.0, 0.0, 0.0), 1.0, size)
    volume, mipmap = PlacedVolume(gpu, placement), VoxelMipmap(gpu, size, 6)
    expected = np.zeros(mipmap_shape(size, 6)[::-1])
    rng = np.random.default_rng(size)
    places = np.ones((500, 4), np.float32)
    places[:, :3] = np.clip(rng.uniform(-1, size + 1, (500, 3)), 0, size)
    place_buffer = gpu.ctx.buffer(places.tobytes())
    found = gpu.ctx.buffer(reserve=2000)
    everything = [(level, direction) for level in range(placement.levels) for direction in range(6)]
    for level, direction in everything:
        threads = ((size >> level) ** 3,)
        paint.run(threads, volume.bindings, mipmap=mipmap.texture, level=level, direction=direction)
        expected[block(size, level, direction)] = level * 8 + direction + 1
    texels = np.frombuffer(mipmap.texture.read(), np.float16).reshape(*expected.shape, 4)
    assert np.array_equal(texels[..., 0], expected)
    for level, direction in everything:
        look_up.run(
            (500,),
            volume.bindings,
            mipmap=mipmap.texture,
            Places=place_buffer,
            Found=found,
            level=level,
            direction=direction,
        )
        values = np.frombuffer(found.read(), np.float32)
        assert values == pytest.approx(level * 8 + direction + 1, abs=1e-3), (level, direction)
    for item in (volume, mipmap, place_buffer, found):
        item.release()


@pytest.mark.parametrize("kind", ["Buffer", "Texture", "Program"])
def test_objects_are_counted_however_many_were_made_before(gpu: GpuContext, kind: str) -> None:
    """Mesa does not use freed names again."""
    make: dict[str, Callable[[], Any]] = {
        "Buffer": lambda: gpu.ctx.buffer(reserve=4),
        "Texture": lambda: gpu.ctx.texture((1, 1), 1),
        "Program": lambda: gpu.ctx.compute_shader(
            "#version 430\nlayout(local_size_x = 1) in; void main() {}"
        ),
    }
    for _ in range(HIGHEST_NAME if kind != "Program" else 1):
        make[kind]().release()
    before = count_gl_objects()[kind]
    made = make[kind]()
    assert count_gl_objects()[kind] == before + 1
    made.release()
    assert count_gl_objects()[kind] == before
