"""Kernels that write whole pictures: in software they are drawn, and give what the compute shader gives."""

import os
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu.context import THREADS, GpuContext, count_gl_objects
from deltalight.render_server.gpu.kernel import BindingError, Dispatch, Kernel, watched
from deltalight.render_server.gpu.picture_kernel import PictureKernel, as_fragment_shader, outputs_of
from deltalight.render_server.gpu.textures import read_texels, texture_2d

SIZE = 70, 45  # odd: quads of fragments reach beyond the picture
WHOLE = (0, 0, *SIZE)
SHADER = """\
layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D light_out;
layout(r32f) writeonly uniform image2D depth_out;
layout(rgba8ui) readonly uniform uimage2D codes;
#pragma outputs light_out depth_out
uniform float scale;
#pragma switch DOUBLED

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy), size = imageSize(codes);
    if (any(greaterThanEqual(pixel, size))) return;
    vec4 code = vec4(imageLoad(codes, pixel));
    if (code.r < 64.0) {
        imageStore(light_out, pixel, vec4(0.0));
        imageStore(depth_out, pixel, vec4(-1.0));
        return;
    }
#ifdef DOUBLED
    code *= 2.0;
#endif
    imageStore(light_out, pixel, scale * (code + vec4(pixel, min(pixel.x, 9), 1.0)));
    imageStore(depth_out, pixel, vec4(code.g));
}
"""


@pytest.fixture
def shader(tmp_path: Path) -> Path:
    (tmp_path / "doubled.comp.glsl").write_text(SHADER)
    return tmp_path / "doubled"


def codes(gpu: GpuContext) -> moderngl.Texture:
    data = np.random.default_rng(2).integers(0, 256, (SIZE[1], SIZE[0], 4), np.uint8)
    return texture_2d(gpu, SIZE, 4, "u1", data=data.tobytes())


def outputs(gpu: GpuContext) -> dict[str, Any]:
    return {"light_out": texture_2d(gpu, SIZE, 4, "f2"), "depth_out": texture_2d(gpu, SIZE, 1, "f4")}


@pytest.mark.parametrize("doubled", [False, True])
def test_it_writes_what_the_compute_shader_writes(gpu: GpuContext, shader: Path, *, doubled: bool) -> None:
    given: dict[str, Any] = {"codes": codes(gpu), "scale": 0.25, "DOUBLED": doubled}
    computing, computed = Kernel(gpu, shader), outputs(gpu)
    computing.run(SIZE, computed, given)
    light, depth = (read_texels(each) for each in computed.values())
    drawing, drawn = PictureKernel(gpu, shader), outputs(gpu)
    drawing.run(WHOLE, drawn, given)
    drawn_light, drawn_depth = (read_texels(each) for each in drawn.values())
    computing.release()
    drawing.release()
    assert np.array_equal(light, drawn_light)
    assert np.array_equal(depth, drawn_depth)
    assert 0 < (depth == -1).mean() < 0.5


def test_a_part_of_the_picture_is_written_from_its_corner_on(gpu: GpuContext, tmp_path: Path) -> None:
    moved = SHADER.replace("pixel = ivec2(gl", "pixel = corner + ivec2(gl").replace(
        "uniform float scale;", "uniform float scale;\nuniform ivec2 corner;"
    )
    (tmp_path / "part.comp.glsl").write_text(moved)
    picture, corner, size, found = codes(gpu), (13, 7), (31, 12), []
    for kind in (Kernel, PictureKernel):
        targets = outputs(gpu)
        named: dict[str, Any] = {"corner": corner, "codes": picture, "scale": 1.0, "DOUBLED": False}
        if kind is PictureKernel:
            PictureKernel(gpu, tmp_path / "part").run((*corner, *size), targets, named)
        else:
            Kernel(gpu, tmp_path / "part").run(size, targets, named)
        inside = np.s_[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
        depth = read_texels(targets["depth_out"])
        found.append(depth[inside].copy())
        if kind is PictureKernel and gpu.is_software:
            depth = depth.copy()
            depth[inside] = 0
            assert not depth.any()
    assert np.array_equal(found[0], found[1])


def test_outputs_are_of_the_declared_format_and_of_one_run_after_another(
    gpu: GpuContext, shader: Path
) -> None:
    kernel, picture, targets = PictureKernel(gpu, shader), codes(gpu), outputs(gpu)
    given: dict[str, Any] = {"codes": picture, "scale": 1.0, "DOUBLED": False}
    with pytest.raises(BindingError, match="light_out"):
        kernel.run(WHOLE, {**targets, "light_out": texture_2d(gpu, SIZE, 4, "f4")}, given)
    with pytest.raises(BindingError, match="depth_out"):
        kernel.run(WHOLE, {"light_out": targets["light_out"]}, given)
    with pytest.raises(BindingError, match="declares no `scales`"):
        kernel.run(WHOLE, targets, given, scales=2.0)
    seen: list[Dispatch] = []
    with watched(gpu, seen.append):
        kernel.run(WHOLE, targets, given)
    assert {name: seen[0].written[name] for name in targets} == targets
    others = outputs(gpu)
    kernel.run(WHOLE, others, given)
    for name, texture in targets.items():
        assert np.array_equal(read_texels(texture), read_texels(others[name]))
    kernel.release()


def test_no_framebuffer_is_left(gpu: GpuContext, shader: Path) -> None:
    targets, picture = outputs(gpu), codes(gpu)
    before = count_gl_objects()["Framebuffer"]
    kernel = PictureKernel(gpu, shader)
    for _ in range(3):
        kernel.run(WHOLE, targets, codes=picture, scale=1.0, DOUBLED=False)
        kernel.run(WHOLE, outputs(gpu), codes=picture, scale=1.0, DOUBLED=False)
    kernel.release()
    assert count_gl_objects()["Framebuffer"] == before


def test_stores_become_assignments_of_the_outputs_that_the_defines_leave() -> None:
    source = SHADER.replace(
        "layout(r32f) writeonly uniform image2D depth_out;",
        "#ifdef DEEP\nlayout(r32f) writeonly uniform image2D depth_out;\n#endif",
    )
    assert dict(outputs_of(source)) == {"light_out": "rgba16f"}
    drawn = as_fragment_shader(source)
    assert "layout(location = 0) out vec4 light_out;" in drawn
    assert "light_out = scale * (code + vec4(pixel, min(pixel.x, 9), 1.0));" in drawn
    assert "local_size" not in drawn
    assert "layout(rgba8ui) readonly uniform uimage2D codes;" in drawn


@pytest.mark.skipif(not THREADS.is_dir() or (os.cpu_count() or 1) < 2, reason="needs Linux and two cores")
def test_raster_threads_lie_on_different_cores(gpu: GpuContext) -> None:
    if not gpu.is_software:
        pytest.skip("a GPU has no raster threads")
    cores = [
        os.sched_getaffinity(int(thread.name))
        for thread in THREADS.iterdir()
        if (thread / "comm").read_text().startswith("llvmpipe-")
    ]
    assert all(len(each) == 1 for each in cores)
    assert len(set.union(*cores)) == min(len(cores), len(os.sched_getaffinity(0)))
