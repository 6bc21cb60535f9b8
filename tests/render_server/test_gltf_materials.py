"""glTF materials as they are drawn: closed forms of plates with textures."""

from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.benchmarks.gltf_plate import Plate, even
from deltalight.protocol.frames import decode_lut
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.mesh_buffers import MapArray
from deltalight.render_server.scene.texture_maps import TextureMap
from tests.render_server.gltf_plates import CENTRE, INSIDE, LEFT, RIGHT, plate, seen_from_above
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    depth_image,
    directional,
    frame,
    look_at,
    noisy,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
LINEAR = decode_lut(None)[:, 0]
NEAREST = {"magFilter": 9728, "minFilter": 9728}
OBLIQUE = (-0.6, -0.3, -0.74)  # travels to -x and -y


Draw = Callable[..., np.ndarray]


@pytest.fixture
def draw(objects: ObjectsRenderer, tmp_path: Path) -> Draw:
    """Draws a plate under some lights; returns the linear picture."""

    numbers = count()  # of files: renderers keep an asset that they loaded

    def drawn(
        plate: Plate, lights: list[dict[str, Any]] | None = None, node: dict[str, Any] | None = None
    ) -> np.ndarray:
        stage = Stage(tmp_path)
        path = plate.write(tmp_path / f"plate{next(numbers)}.glb", node)
        asset = {"asset": str(path), "up_axis": "z"}
        return objects.linear(unlit(stage.document([asset], lights or [])), seen_from_above())

    return drawn


@pytest.mark.parametrize("codes", [None, (10, 20, 30)], ids=["none", "one texel"])
def test_arrays_of_maps_have_mip_levels_whatever_they_hold(
    gpu: GpuContext, codes: tuple[int, ...] | None
) -> None:
    """Else llvmpipe would compile all kernels with maps anew for the first model whose maps are of both kinds."""
    maps = [] if codes is None else [TextureMap(even(*codes, size=1))]
    array = MapArray(gpu, maps, "f1")
    assert array.texture.width == array.texture.height == 2
    held = np.frombuffer(array.texture.read(), np.uint8).reshape(-1, 4)
    array.release()
    assert codes is None or (held == (*codes, 255)).all()


def glowing(codes: np.ndarray, sampler: dict[str, Any] | None = None, **options: Any) -> Plate:  # noqa: ANN401
    """A black plate whose emission is a texture."""
    made = plate(**options.pop("plate", {}))
    made.material |= {
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
        "emissiveTexture": made.texture(codes, sampler, **options),
        "emissiveFactor": [1, 1, 1],
    }
    return made


def halves(left: int, right: int) -> np.ndarray:
    codes = even(left, left, left, size=8)
    codes[:, 4:] = right
    return codes


def test_an_emissive_texture_glows_with_its_value_times_the_strength(draw: Draw) -> None:
    made = glowing(halves(128, 0))
    made.material["emissiveFactor"] = [1.0, 0.5, 0.25]
    made.material["extensions"]["KHR_materials_emissive_strength"] = {"emissiveStrength": 2.0}
    picture = draw(made)
    expected = 2 * LINEAR[128] * np.array([1.0, 0.5, 0.25])
    assert picture[LEFT].reshape(-1, 3) == pytest.approx(np.tile(expected, (800, 1)), rel=0.01)
    assert np.abs(picture[RIGHT]).max() < 1e-3


def test_a_texture_of_roughness_and_metal_is_as_the_factors(draw: Draw) -> None:
    lights = [directional((0.05, 0.02, -1.0), 2.0, 2.0), ambient(0.1)]
    pictures = []
    for is_texture in (True, False):
        made = plate()
        pbr: dict[str, Any] = {"baseColorFactor": [0.8, 0.5, 0.2, 1]}
        if is_texture:
            pbr |= {"roughnessFactor": 0.8, "metallicFactor": 0.9}
            pbr["metallicRoughnessTexture"] = made.texture(even(7, 128, 204))
        else:
            pbr |= {"roughnessFactor": 0.8 * 128 / 255, "metallicFactor": 0.9 * 204 / 255}
        made.material = {"pbrMetallicRoughness": pbr}
        pictures.append(draw(made, lights)[INSIDE])
    assert pictures[0] == pytest.approx(pictures[1], rel=6e-3, abs=1e-3)
    assert pictures[0].max() > 1.5 * np.median(pictures[0]), "a highlight is seen"


SPECULAR: dict[str, tuple[dict[str, Any], dict[str, tuple[int, ...]]]] = {
    "specular": (
        {
            "specularFactor": 0.8 * 128 / 255,
            "specularColorFactor": [float(LINEAR[code]) for code in (200, 150, 90)],
        },
        {"specularTexture": (0, 0, 0, 128), "specularColorTexture": (200, 150, 90)},
    ),
    "transmission": ({"transmissionFactor": 0.8 * 128 / 255}, {"transmissionTexture": (128, 0, 0)}),
}


@pytest.mark.parametrize("name", SPECULAR)
def test_textures_of_specular_and_transmission_are_as_the_factors(draw: Draw, name: str) -> None:
    """A dark plate under a lamp, whose highlight is seen; a pale one, whose diffuse part is what does not pass."""
    lights = [directional((0.05, 0.02, -1.0), 4.0, 2.0), ambient(0.3)]
    factors, textures = SPECULAR[name]
    color = 0.0 if name == "specular" else 0.8
    pictures = []
    for is_texture in (True, False):
        made = plate()
        pbr = {"baseColorFactor": [color] * 3 + [1], "metallicFactor": 0, "roughnessFactor": 0.4}
        given = {f"{name}Factor": 0.8, **{key: made.texture(even(*code)) for key, code in textures.items()}}
        extension = {f"KHR_materials_{name}": given if is_texture else factors}
        made.material = {
            "pbrMetallicRoughness": pbr,
            "extensions": {"KHR_materials_ior": {"ior": 1.8}, **extension},
        }
        pictures.append(draw(made, lights)[INSIDE])
    assert pictures[0] == pytest.approx(pictures[1], rel=0.02, abs=1e-3)
    assert pictures[1].max() > 0.05


def lambert(normal: Any) -> float:  # noqa: ANN401
    """Radiance of a white plate of that normal in the oblique light."""
    normal = np.array(normal) / np.linalg.norm(normal)
    to_light = -np.array(OBLIQUE) / np.linalg.norm(OBLIQUE)
    return float(2.0 / np.pi * normal @ to_light)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_normal_map_of_one_tilt_shades_as_a_tilted_plate(draw: Draw, axis: int, mirrored: bool) -> None:
    """Red tilts along u, green against v, on mirrored coordinates too. (A tilted one sees a little of the floor.)"""
    made = plate(mirrored=mirrored)
    code = [128, 128, 231]
    code[axis] = 204
    made.material["pbrMetallicRoughness"] = {"metallicFactor": 0}
    made.material["normalTexture"] = made.texture(even(*code), scale=0.5)
    tilt = np.array(code) / 255 * 2 - 1
    tilt[:2] *= 0.5
    if mirrored:
        tilt[0] = -tilt[0]
    picture = draw(made, [directional(OBLIQUE)])[INSIDE]
    assert picture == pytest.approx(np.full_like(picture, lambert(tilt)), rel=6e-3)


def turned_about_z(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def bumped(axis: int) -> Plate:
    """A plate whose normal map tilts along one axis throughout."""
    made = plate()
    code = [128, 128, 231]
    code[axis] = 204
    made.material["pbrMetallicRoughness"] = {"metallicFactor": 0}
    made.material["normalTexture"] = made.texture(even(*code), scale=0.5)
    return made


BUMP = 0.5 * (204 / 255 * 2 - 1)
FLAT = 0.5 * (128 / 255 * 2 - 1), 231 / 255 * 2 - 1  # the other axis, and the normal's


def tilted(across: np.ndarray, other: np.ndarray) -> np.ndarray:
    return BUMP * across + FLAT[0] * other + np.array([0, 0, FLAT[1]])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("antialiased", [False, True])
def test_tangents_of_the_file_turn_a_normal_map(
    objects: ObjectsRenderer, tmp_path: Path, axis: int, sign: float, antialiased: bool
) -> None:
    """By 50 degrees against the texture coordinates; a negative sign mirrors the map's y (NormalTangentTest)."""
    made = bumped(axis)
    tangent = turned_about_z(np.radians(50))
    made.attributes["TANGENT"] = made.glb.floats([(*tangent, sign)] * 4)
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "up_axis": "z"}
    document = unlit(Stage(tmp_path).document([asset], [directional(OBLIQUE)]))
    output = document.output.model_copy(update={"antialiasing": antialiased})
    picture = objects.linear(document.replaced(output=output), seen_from_above())[INSIDE]
    axes = [tangent, sign * np.cross([0, 0, 1], tangent)]
    expected = lambert(tilted(axes[axis], axes[1 - axis]))
    assert picture == pytest.approx(np.full_like(picture, expected), rel=6e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_turn_with_the_object(draw: Draw, mirrored: bool) -> None:
    """A node turns the plate by 40 degrees about its normal, or mirrors it at x = 0."""
    made = bumped(1)
    tangent = turned_about_z(np.radians(50))
    made.attributes["TANGENT"] = made.glb.floats([(*tangent, 1.0)] * 4)
    turned = {"rotation": [0, 0, np.sin(np.radians(20)), np.cos(np.radians(20))]}
    picture = draw(made, [directional(OBLIQUE)], node={"scale": [-1, 1, 1]} if mirrored else turned)[CENTRE]
    angle = np.radians(50) + (0 if mirrored else np.radians(40))
    axes = np.array([turned_about_z(angle), turned_about_z(angle + np.pi / 2)])
    axes[:, 0] *= -1 if mirrored else 1
    expected = lambert(tilted(axes[1], axes[0]))
    assert picture == pytest.approx(np.full_like(picture, expected), rel=6e-3)


def test_tangents_without_normals_do_not_count(draw: Draw) -> None:
    """As the specification says: the client's own normals have the client's own tangents."""
    made = bumped(0)
    del made.attributes["NORMAL"]
    made.attributes["TANGENT"] = made.glb.floats([(*turned_about_z(1.0), 1.0)] * 4)
    picture = draw(made, [directional(OBLIQUE)])[INSIDE]
    expected = lambert(tilted(np.array([1, 0, 0]), np.array([0, 1, 0])))
    assert picture == pytest.approx(np.full_like(picture, expected), rel=6e-3)


@pytest.mark.parametrize("given", [False, True])
def test_bumps_seen_from_behind_are_dents(draw: Draw, given: bool) -> None:
    """The back of a double-sided surface has the whole bent normal reversed (glTF 2.0, section 3.9.6).

    Turned about y, a tilt to +x that is reversed is one to +x again.
    """
    pictures = []
    for node in (None, {"rotation": [0, 1, 0, 0]}):
        made = bumped(0)
        made.material["doubleSided"] = True
        if given:
            made.attributes["TANGENT"] = made.glb.floats([(1, 0, 0, 1)] * 4)
        pictures.append(draw(made, [directional(OBLIQUE)], node=node)[INSIDE])
    assert pictures[1] == pytest.approx(pictures[0], rel=6e-3)


def test_occlusion_dims_indirect_light_only(draw: Draw) -> None:
    pictures = []
    for lights in ([ambient(0.4)], [directional()]):
        made = plate()
        made.material["pbrMetallicRoughness"] = {"metallicFactor": 0}
        codes = halves(51, 255)
        codes[..., 1:] = 9
        made.material["occlusionTexture"] = made.texture(codes, strength=0.5)
        pictures.append(draw(made, lights))
    shade = np.median(pictures[0][LEFT]) / np.median(pictures[0][RIGHT])
    assert shade == pytest.approx(1 + 0.5 * (51 / 255 - 1), rel=3e-3)
    assert np.median(pictures[0][RIGHT]) == pytest.approx(0.4, rel=0.02)
    assert pictures[1][INSIDE] == pytest.approx(np.full_like(pictures[1][INSIDE], 2 / np.pi), rel=3e-3)


def test_a_picture_of_black_and_white_averages_in_linear_light(draw: Draw) -> None:
    """Squares far smaller than a pixel: half of white's light, not the mean of codes."""
    squares = np.indices((64, 64)).sum(axis=0) % 2 * 255
    made = glowing(np.repeat(squares[..., None], 3, axis=2), plate={"repeats": 16.0})
    assert draw(made)[INSIDE] == pytest.approx(np.full((48, 64, 3), 0.5), rel=6e-3)


QUARTERS = np.array([[10, 80], [150, 255]], np.uint8)[..., None].repeat(3, axis=2)


def corners_of(picture: np.ndarray) -> list[list[int]]:
    """Codes of the plate's four quarters."""
    rows, columns = (HEIGHT // 2 - 16, HEIGHT // 2 + 16), (WIDTH // 2 - 20, WIDTH // 2 + 20)
    return [[int(np.abs(LINEAR - picture[row, column, 0]).argmin()) for column in columns] for row in rows]


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        ({}, [[10, 80], [150, 255]]),
        ({"offset": [0.5, 0]}, [[80, 10], [255, 150]]),
        ({"scale": [1, -1]}, [[150, 255], [10, 80]]),
        ({"scale": [0.5, 0.5], "offset": [0.5, 0.0]}, [[80, 80], [80, 80]]),
        # Counter-clockwise where v points down: the corner (1, 0) goes to (0, -1).
        ({"rotation": np.pi / 2}, [[150, 10], [255, 80]]),
    ],
)
def test_a_texture_transform_moves_known_texels(
    draw: Draw, transform: dict[str, Any], expected: list[list[int]]
) -> None:
    made = glowing(QUARTERS, NEAREST, extensions={"KHR_texture_transform": transform})
    assert corners_of(draw(made)) == [[pytest.approx(code, abs=1) for code in row] for row in expected]


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [(10497, [[10, 10], [10, 10]]), (33071, [[10, 80], [150, 255]]), (33648, [[10, 80], [150, 255]])],
)
def test_what_lies_beyond_the_edge_repeats_clamps_or_mirrors(
    draw: Draw, wrap: int, expected: list[list[int]]
) -> None:
    """Three quarters of the plate lie beyond; texels are looked at near (1/4, 1/4) and (5/4, 5/4)."""
    sampler = {**NEAREST, "wrapS": wrap, "wrapT": wrap}
    picture = draw(glowing(QUARTERS, sampler, plate={"repeats": 2.0}))
    place = (HEIGHT // 2 - 24, WIDTH // 2 - 30), (HEIGHT // 2 + 8, WIDTH // 2 + 10)
    rows, columns = zip(*place, strict=True)
    found = [[int(np.abs(LINEAR - picture[row, column, 0]).argmin()) for column in columns] for row in rows]
    assert found == [[pytest.approx(code, abs=1) for code in row] for row in expected]


def test_a_map_may_lie_on_the_second_texture_coordinates(draw: Draw) -> None:
    made = glowing(QUARTERS, NEAREST, texCoord=1)
    made.attributes["TEXCOORD_1"] = made.glb.floats([(1, 0), (0, 0), (0, 1), (1, 1)])
    assert corners_of(draw(made)) == [[255, 150], [80, 10]]


def test_unlit_shows_its_colour_in_any_light(draw: Draw) -> None:
    made = plate()
    made.material["pbrMetallicRoughness"] = {
        "baseColorFactor": [0.5, 1, 1, 1],
        "baseColorTexture": made.texture(even(188, 188, 188)),
    }
    made.material["extensions"]["KHR_materials_unlit"] = {}
    for lights in ([], [directional(), ambient(1.0)]):
        picture = draw(made, lights)[INSIDE]
        expected = np.broadcast_to(LINEAR[188] * np.array([0.5, 1, 1]), picture.shape)
        assert picture == pytest.approx(expected, rel=6e-3)


@pytest.mark.parametrize("has_texture", [False, True])
def test_vertex_colours_tint_what_is_unlit(draw: Draw, has_texture: bool) -> None:
    """As they tint the base colour of what is lit (KHR_materials_unlit)."""
    made = plate()
    made.attributes["COLOR_0"] = made.glb.floats([(0.25, 1.0, 0.5)] * 4)
    made.material["pbrMetallicRoughness"] = {"baseColorFactor": [0.5, 1, 1, 1]}
    texel = 1.0
    if has_texture:
        made.material["pbrMetallicRoughness"]["baseColorTexture"] = made.texture(even(188, 188, 188))
        texel = LINEAR[188]
    made.material["extensions"]["KHR_materials_unlit"] = {}
    picture = draw(made, [directional(), ambient(1.0)])[INSIDE]
    expected = texel * np.array([0.5, 1, 1]) * (0.25, 1.0, 0.5)
    assert picture == pytest.approx(np.broadcast_to(expected, picture.shape), rel=0.02)


def test_stripes_that_run_away_stay_apart_at_a_grazing_angle(
    objects: ObjectsRenderer, tmp_path: Path
) -> None:
    """A pixel's footprint is ten texels long and less than one wide: stripes along it do not run into each other."""
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, np.arange(64) % 8 < 4] = 255
    made = Plate(0.6, 2.0)
    made.material |= {
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
        "emissiveTexture": made.texture(stripes, extensions={"KHR_texture_transform": {"scale": [1, 8]}}),
        "emissiveFactor": [1, 1, 1],
    }
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "up_axis": "z"}
    depth = depth_image(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    view = frame(noisy(), pose=look_at((0.0, -0.8, 0.1), (0.0, 0.0, 0.0)), depth=depth)
    picture = objects.linear(unlit(Stage(tmp_path).document([asset], [])), view)
    row = picture[HEIGHT // 2, WIDTH // 2 - 40 : WIDTH // 2 + 40, 0]
    assert row.mean() == pytest.approx(0.5, abs=0.08)
    assert row.std() > 0.4, "grey would have no deviation, sharp stripes one of 0.5"


def test_users_read_what_of_a_file_is_left_out(objects: ObjectsRenderer, draw: Draw) -> None:
    made = plate()
    made.glb.document["extensionsUsed"] = ["KHR_materials_iridescence"]
    draw(made, [directional()])
    assert objects.renderer.notices[-1].endswith("plate0.glb is shown without KHR_materials_iridescence.")
