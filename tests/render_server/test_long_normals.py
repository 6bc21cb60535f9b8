"""Normals longer than 1, as rounding to half floats makes them on GPUs, leave what is shaded finite and as bright.

llvmpipe truncates instead, so its own normals are never too long: these tests lengthen them.
"""

from collections.abc import Mapping
from pathlib import Path

import moderngl
import numpy as np
import pytest

from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu import kernel as kernel_module
from deltalight.render_server.gpu import picture_kernel, raster_kernel
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.shader_source import shader_source
from tests.render_server.scenes import (
    GREY,
    Stage,
    ambient,
    composite,
    cube,
    depth_image,
    directional,
    floor_depth,
    frame,
    look_at,
    plain,
)
from tests.render_server.tiny_kernel import MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")
LONG = 1.0 + 2.0**-10  # the longest that rounding makes it: half a step of each component
LENGTHENED = {
    "geometry_buffer.frag.glsl": (
        "out_normal = s.normal;",
        f"out_normal = vec4({LONG!r} * s.normal.xyz, s.normal.w);",
    ),
    "real_surface.comp.glsl": (
        "normal_out, pixel, vec4(normal,",
        f"normal_out, pixel, vec4({LONG!r} * normal,",
    ),
}

BRDF = """
uniform vec3 n, v, l;
uniform float roughness;
#include "common/brdf.glsl"
"""
RESPONSES = """
values[0] = diffuse_under_lobe(vec3(0.04), roughness, dot(n, l), dot(n, v)).g;
values[1] = specular_reflectance(vec3(0.04), roughness, dot(n, v)).g;
vec3 specular = specular_times_cosine(n, v, l, vec3(0.04), roughness, vec2(0.0));
values[2] = specular.g;
values[3] = fresnel_schlick(vec3(0.04), dot(n, v)).g;
"""


def up(length: float) -> tuple[float, float, float]:
    return (0.0, 0.0, length)


@pytest.mark.parametrize("roughness", [0.0, 0.01, 0.2, 0.5, 1.0])
def test_the_brdf_of_a_long_normal_is_that_of_a_unit_one(
    make: MakeKernel, out: moderngl.Buffer, roughness: float
) -> None:
    """Where the light and the eye stand above it, so that the cosines exceed 1."""
    kernel = make(BRDF, RESPONSES)

    def responses(length: float) -> np.ndarray:
        kernel.run((1,), Out=out, n=up(length), v=up(1.0), l=up(1.0), roughness=roughness)
        return np.array(floats(out, 4))

    for length in (1.0 + 2.0**-12, LONG):
        assert responses(length) == pytest.approx(responses(1.0), rel=0.01)


@pytest.mark.parametrize("length", [1.0, LONG])
def test_the_lobe_is_never_above_its_peak(make: MakeKernel, out: moderngl.Buffer, length: float) -> None:
    """Near the mirror direction a cosine above 1 made the lobe's denominator vanish."""
    roughness = 0.1
    kernel = make(BRDF, RESPONSES)
    kernel.run((1,), Out=out, n=up(1.0), v=up(1.0), l=up(1.0), roughness=roughness)
    peak = floats(out, 3)[2]
    for angle in np.linspace(0.0, 0.2, 41):
        light = (float(np.sin(angle)), 0.0, float(np.cos(angle)))
        kernel.run((1,), Out=out, n=up(length), v=up(1.0), l=light, roughness=roughness)
        assert 0.0 <= floats(out, 3)[2] <= 1.01 * peak, angle


def test_opposite_directions_have_no_half_vector_and_a_finite_highlight(
    make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make(BRDF, RESPONSES)
    kernel.run((1,), Out=out, n=up(1.0), v=up(-1.0), l=up(1.0), roughness=0.5)
    assert 0.0 <= floats(out, 3)[2] <= 1.0


def document(stage: Stage) -> SceneDocument:
    """A cube under the sun, to which its top faces, on a floor that is measured."""
    shiny = {"roughness": 0.7, "specular": 0.5}
    lights = [directional((0.0, 0.0, -1.0), 1.0), ambient(0.15)]
    return stage.document([stage.virtual(cube(), (0.6, 0.6, 0.6), shiny)], lights)


def test_a_picture_with_long_normals_is_the_same_but_for_their_length(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = frame(plain(GREY), depth=depth_image(floor_depth(look_at())))
    expected = composite(gpu, document(Stage(tmp_path)), view).astype(int)
    changed: set[str] = set()

    def lengthened(path: Path, defines: Mapping[str, int | float | str] | None = None) -> str:
        text = shader_source(path, defines)
        for old, new in [LENGTHENED[path.name]] if path.name in LENGTHENED else []:
            assert old in text
            changed.add(path.name)
            text = text.replace(old, new)
        return text

    for module in (kernel_module, picture_kernel, raster_kernel):
        monkeypatch.setattr(module, "shader_source", lengthened)
    found = composite(gpu, document(Stage(tmp_path)), view).astype(int)
    assert changed == set(LENGTHENED)
    assert np.abs(found - expected).max() <= 2
