"""ABTF: a stack of textures by the light's angle, read from a folder, drawn as it says, refused in one sentence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.benchmarks.relief_materials import latitude_longitude
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import EnvironmentLights, Lights
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.material_file import read_material, write_material
from deltalight.render_server.scene.polynomial_texture import PolynomialTexture, polynomial_terms
from deltalight.render_server.scene.texture_stack import LAYERS, TextureStack, read_texture_stack
from deltalight.render_server.scene.textures_by_light import TextureByLight
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
    plain,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
LAMP = (-0.45, -0.3, -0.84)
LEFT, RIGHT = np.s_[50:70, 55:70], np.s_[50:70, 90:105]
TINT = np.array([1.0, 0.8, 0.5])
STEPS = np.linspace(0, 1, LAYERS)
GRADIENT = np.array([0.25, 0.1, 0.2])  # of radiance along x, y, z
EYES = [(0.0, 0.0, 1.0), (0.5, -0.3, 0.8)]


def stack_of_halves(left: np.ndarray, right: np.ndarray, *coat: float) -> TextureStack:
    """Values by STEPS of both halves, 16 x 8 texels each."""
    made = np.repeat(np.stack([left, right], axis=1)[:, None, :, None] * TINT, 16, axis=1)
    return TextureStack(np.repeat(made, 16, axis=2).astype(np.float16), *coat)


def relief() -> TextureStack:
    """One half falls into its own shadow where light grazes, the other flattens where it is steep."""
    return stack_of_halves(0.7 * np.maximum(STEPS - 0.3, 0) / 0.7, 0.5 * np.sqrt(STEPS))


def seen(eye: tuple[float, float, float] = EYES[0]) -> ViewFrame:
    depth = depth_image(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    return frame(plain(0), pose=look_at(eye, (0.0, 0.0, 0.0)), depth=depth)


def plate(folder: Path, material: TextureByLight | dict[str, Any], **pose: object) -> dict[str, Any]:
    if not isinstance(material, dict):
        path = folder / f"{type(material).__name__}.dlmat"
        write_material(path, material)
        material = {"precomputed": str(path)}
    asset = Plate(0.5, 0.4).write(folder / "plate.glb")
    return {"asset": str(asset), "up_axis": "z", "material": material, "pose": pose}


def under_a_lamp(folder: Path, material: TextureByLight | dict[str, Any], way: Any = LAMP) -> SceneDocument:  # noqa: ANN401
    return unlit(Stage(folder).document([plate(folder, material)], [directional(way, 2.0)]))


@pytest.mark.parametrize("way", [LAMP, (0.1, -0.2, -0.97), (0.9, 0.1, -0.35)])
def test_a_plate_under_a_lamp(objects: ObjectsRenderer, tmp_path: Path, way: tuple[float, ...]) -> None:
    picture = objects.linear(under_a_lamp(tmp_path, relief(), way), seen())
    cosine = -way[2] / np.linalg.norm(way)
    for half, pixels in enumerate((LEFT, RIGHT)):
        layers = relief().layers[:, 0, 31 * half].astype(float)
        wanted = 2.0 / np.pi * np.array([np.interp(cosine, STEPS, layers[:, c]) for c in range(3)])
        assert picture[pixels].reshape(-1, 3) == pytest.approx(np.tile(wanted, (300, 1)), rel=0.01)


@pytest.mark.parametrize("eye", EYES)
def test_a_coated_lambertian_stack_is_the_material_in_numbers(
    objects: ObjectsRenderer, tmp_path: Path, eye: tuple[float, float, float]
) -> None:
    """0.6 cos, under a coat of F0 0.04: in the lamp's light, mirrored too, and in even light."""
    lambertian = np.repeat(0.6 * STEPS[:, None], 3, axis=1)[:, None, None] * np.ones((1, 8, 8, 1))
    stack = TextureStack(lambertian.astype(np.float16), 0.04, 0.3)
    numbers = {"base_color": [0.6] * 3, "specular": 0.5, "roughness": 0.3}
    way = tuple(-np.array(eye) * (-1, -1, 1)) if eye[0] else LAMP  # mirrored at the plate's middle
    pictures = []
    for each in (stack, numbers):
        document = under_a_lamp(tmp_path, each, way)
        lights = [directional(way, 1.0), ambient(0.2)]
        given = document.lights.model_dump() | {"manual": lights}
        pictures.append(objects.linear(document.replaced(lights=Lights.model_validate(given)), seen(eye)))
    shown = pictures[1].sum(axis=2) > 0
    assert shown.sum() > 2000
    assert pictures[0][shown] == pytest.approx(pictures[1][shown], rel=0.005)


def test_a_coat_shines_by_the_relief(objects: ObjectsRenderer, tmp_path: Path) -> None:
    """In the mean over the texture it is what it is on a plain surface, and dark places have less of it."""
    coated = stack_of_halves(0.6 * STEPS, 0.2 * STEPS, 0.1, 0.5)
    bare = stack_of_halves(0.6 * STEPS, 0.2 * STEPS)
    numbers = {"base_color": [0, 0, 0], "specular": 1.0, "roughness": 0.5}
    way, black = (0.0, 0.0, -1.0), TextureStack(np.zeros((LAYERS, 4, 4, 3), np.float16))
    shine, base, alone, _ = (
        objects.linear(under_a_lamp(tmp_path, each, way), seen()) for each in (coated, bare, numbers, black)
    )
    gained = [shine[half].mean() - 0.85 * base[half].mean() for half in (LEFT, RIGHT)]
    assert gained[0] > 2 * gained[1] > 0
    assert 0.5 * sum(gained) < 2 * alone[LEFT].mean()


def test_even_light_meets_its_albedo(objects: ObjectsRenderer, tmp_path: Path) -> None:
    document = unlit(Stage(tmp_path).document([plate(tmp_path, relief())], [ambient(0.5)]))
    picture = objects.linear(document, seen())
    for half, pixels in enumerate((LEFT, RIGHT)):
        layers = relief().layers[:, 0, 31 * half].astype(float)
        wanted = 0.5 * 2 * np.trapezoid(layers, STEPS, axis=0)
        assert picture[pixels].reshape(-1, 3).mean(axis=0) == pytest.approx(wanted, rel=0.01)


def leaning() -> PolynomialTexture:
    """Brighter under light from the right, darker under light from above."""
    terms = np.array([0.5, 0.25, -0.15, -0.2, 0.0, -0.1])
    return PolynomialTexture((terms[:, None, None, None] * np.ones((1, 8, 8, 1)) * TINT).astype(np.float16))


def gradient_scene(folder: Path, texture: TextureByLight, name: str) -> SceneDocument:
    """The plate turned by 90 degrees about its normal under a sky that changes evenly along three axes."""
    sky = np.repeat((0.5 + latitude_longitude() @ GRADIENT)[..., None], 3, axis=2).astype(np.float32)
    cv2.imwrite(str(folder / "sky.hdr"), sky)
    given = EnvironmentLights(map=str(folder / "sky.hdr"))
    turned = plate(folder, texture, rotation_wxyz=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    document = unlit(Stage(folder).document([turned], []))
    lights = Lights(mode="environment", environment=given, registration=(1.0, 1.0, 1.0))
    return document.replaced(lights=lights, shading=Shading(rays=64, bounces=0).replaced(name=name))


@pytest.mark.parametrize("name", ["image_based", "precomputed"])
def test_a_map_of_light_is_integrated_with_the_texture(gpu: GpuContext, tmp_path: Path, name: str) -> None:
    """Of a sky that its harmonics hold whole, the integral of radiance and response over the hemisphere."""
    k = np.arange(20000)
    z, turn = (k + 0.5) / len(k), k * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - z * z)
    own = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)  # right, up, normal of the map
    sky = 0.5 + np.stack([-own[:, 1], own[:, 0], z], axis=1) @ GRADIENT  # turned
    codes = (
        np.clip(polynomial_terms(own) @ np.array([0.5, 0.25, -0.15, -0.2, 0.0, -0.1]), 0, 1)[:, None] * TINT
    )
    leant = np.where(codes > 0.04045, ((codes + 0.055) / 1.055) ** 2.4, codes / 12.92)
    steep = np.interp(z, STEPS, relief().layers[:, 0, 0, 0].astype(float))[:, None] * TINT
    half = relief().layers[:, 0, 0, 0].astype(float)
    stack = stack_of_halves(half, half)
    renderer = SceneRenderer(gpu, gradient_scene(tmp_path, stack, name), with_linear=True)
    try:
        for made, response in ((stack, steep), (leaning(), leant)):
            renderer.set_scene(gradient_scene(tmp_path, made, name))
            linear = renderer.render(seen()).linear
            assert linear is not None
            wanted = 2 * (sky[:, None] * response).mean(axis=0)
            found = linear[50:70, 70:90].reshape(-1, 3).mean(axis=0)
            print(f"{name}: {found} for {wanted}")
            assert found == pytest.approx(wanted, rel=0.015)
    finally:
        renderer.release()


def captured(folder: Path, albedo: float = 0.5, **info: object) -> Path:
    """Pictures of a Lambertian under lights of four angles, in no order."""
    folder.mkdir(exist_ok=True)
    angles = [60.0, 0.0, 45.0, 75.0]
    codes = [np.searchsorted(decode_lut(None)[:, 0], albedo * np.cos(np.radians(each))) for each in angles]
    for index, code in enumerate(codes):
        Image.fromarray(np.full((6, 9, 3), code, np.uint8)).save(folder / f"{index}.png")
    made = {"type": "abtf", "pictures": [f"{k}.png" for k in range(4)], "angles_deg": angles, **info}
    (folder / "info.json").write_text(json.dumps(made))
    return folder


@pytest.mark.parametrize("angles", [{}, {"angles_deg": None}])
def test_a_folder_of_pictures_is_read(tmp_path: Path, angles: dict[str, None]) -> None:
    """Whether the angles are given, or told by the pictures' means, a Lambertian is one at every step."""
    found = read_texture_stack(captured(tmp_path / "stack", 0.5, **angles, f0=0.04, roughness=0.5))
    assert (found.layers.shape, found.f0, found.roughness) == ((LAYERS, 6, 9, 3), 0.04, 0.5)
    assert found.layers[:, 3, 4, 1] == pytest.approx(0.5 * STEPS, abs=0.004)
    assert found.albedo == pytest.approx(0.5, abs=0.004)


def test_white_is_what_the_description_says(tmp_path: Path) -> None:
    found = read_texture_stack(captured(tmp_path / "stack", 0.3, white=0.6))
    assert found.albedo == pytest.approx(0.5, abs=0.004)


def test_light_from_above_the_steepest_picture_goes_on_as_the_cosine(tmp_path: Path) -> None:
    folder = captured(tmp_path / "stack")
    info = json.loads((folder / "info.json").read_text())
    del info["pictures"][1], info["angles_deg"][1]
    (folder / "info.json").write_text(json.dumps(info))
    assert read_texture_stack(folder).layers[-1] == pytest.approx(0.5, abs=0.01)


def test_large_pictures_are_averaged(tmp_path: Path) -> None:
    folder = captured(tmp_path / "stack")
    for path in folder.glob("*.png"):
        Image.open(path).resize((900, 600)).save(path)
    assert read_texture_stack(folder).layers.shape == (LAYERS, 256, 384, 3)


def test_a_file_holds_the_stack(tmp_path: Path) -> None:
    write_material(tmp_path / "stack.dlmat", stack_of_halves(STEPS, 0.5 * STEPS, 0.04, 0.25))
    again = read_material(tmp_path / "stack.dlmat")
    assert isinstance(again, TextureStack)
    assert (again.f0, again.roughness) == (0.04, 0.25)
    assert np.array_equal(again.layers, stack_of_halves(STEPS, 0.5 * STEPS).layers)


@pytest.mark.parametrize(
    ("layers", "coat"),
    [
        (np.full((LAYERS, 4, 4, 3), np.nan), (0.0, 1.0)),
        (np.full((LAYERS, 4, 4, 3), -0.1), (0.0, 1.0)),
        (np.full((LAYERS, 4, 4, 3), 1e4), (0.0, 1.0)),
        (np.zeros((LAYERS, 4, 400, 3)), (0.0, 1.0)),
        (np.zeros((LAYERS - 1, 4, 4, 3)), (0.0, 1.0)),
        (np.zeros((LAYERS, 0, 4, 3)), (0.0, 1.0)),
        (np.zeros((LAYERS, 4, 4, 3)), (1.5, 1.0)),
        (np.zeros((LAYERS, 4, 4, 3)), (0.0, np.nan)),
    ],
)
def test_a_file_of_something_else_is_refused(
    tmp_path: Path, layers: np.ndarray, coat: tuple[float, float]
) -> None:
    write_material(tmp_path / "stack.dlmat", TextureStack(layers.astype(np.float16), *coat))
    with pytest.raises(DeltalightError, match="holds no material that can be drawn"):
        read_material(tmp_path / "stack.dlmat")


def described(**changes: object) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        info = json.loads((folder / "info.json").read_text()) | changes
        (folder / "info.json").write_text(json.dumps(info))

    return change


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (described(pictures=["0.png"], angles_deg=[0]), "describes no ABTF"),
        (described(pictures=None), "describes no ABTF"),
        (described(pictures=["../0.png", "1.png", "2.png", "3.png"]), "describes no ABTF"),
        (described(angles_deg=[0, 10, 20]), "describes no ABTF"),
        (described(angles_deg=[0, 10, 20, 90]), "describes no ABTF"),
        (described(angles_deg=[0, 10, 20, 20]), "describes no ABTF"),
        (described(angles_deg=["a", "b", "c", "d"]), "describes no ABTF"),
        (described(white=0), "describes no ABTF"),
        (described(f0=float("nan")), "describes no ABTF"),
        (described(roughness=[0.2, 0.3]), "describes no ABTF"),
        (
            lambda folder: [
                described(angles_deg=None)(folder),
                (folder / "0.png").write_bytes((folder / "1.png").read_bytes()),
            ],
            "equally bright do not show their light's angle; give `angles_deg`",
        ),
        (lambda folder: (folder / "2.png").write_bytes(b"\x89PNG"), "2.png cannot be read as a picture"),
        (lambda folder: (folder / "2.png").unlink(), "2.png cannot be read as a picture"),
        (lambda folder: Image.new("RGB", (8, 8)).save(folder / "0.png"), "have several sizes"),
        (lambda folder: (folder / "info.json").write_text("["), "is not a JSON document"),
        (lambda folder: (folder / "info.json").write_text("[]"), "holds no JSON object"),
        (lambda folder: (folder / "info.json").write_bytes(b" " * (2 << 20)), "has more than 1 MB"),
    ],
)
def test_bad_folders(tmp_path: Path, change: Callable[[Path], object], sentence: str) -> None:
    folder = captured(tmp_path / "stack")
    change(folder)
    with pytest.raises(DeltalightError, match=sentence):
        read_texture_stack(folder)
