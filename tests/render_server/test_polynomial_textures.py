"""Polynomial texture maps: read as Relight writes them, drawn as their polynomials say, refused in one sentence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.material_file import read_material, write_material
from deltalight.render_server.scene.polynomial_texture import (
    PolynomialTexture,
    polynomial_terms,
    read_polynomial_texture,
)
from deltalight.render_server.scene.ptm_file import read_ptm
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    cube,
    depth_image,
    directional,
    frame,
    look_at,
    plain,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
LAMP = (-0.45, -0.3, -0.84)  # travels to -x and -y: it shines from the right and from above
LEFT, RIGHT = np.s_[50:70, 55:70], np.s_[50:70, 90:105]
TERMS = np.array(  # of the left and the right half, R G B alike but for factors
    [[0.5, 0.2, 0.1, -0.2, 0.05, -0.1], [0.5, -0.1, 0.25, -0.1, 0.0, -0.2]]
)
TINT = np.array([1.0, 0.8, 0.5])


def two_halves() -> PolynomialTexture:
    made = np.repeat(TERMS.T[:, None, :], 8, axis=2)[..., None] * TINT
    return PolynomialTexture(np.repeat(made, 16, axis=1).astype(np.float16))


def seen() -> ViewFrame:
    depth = depth_image(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    return frame(plain(0), pose=look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), depth=depth)


def decoded(codes: np.ndarray) -> np.ndarray:
    """sRGB (IEC 61966-2-1)."""
    inside = np.clip(codes, 0, 1)
    return np.where(inside > 0.04045, ((inside + 0.055) / 1.055) ** 2.4, inside / 12.92)


def polynomial(half: int, towards: np.ndarray) -> np.ndarray:
    directions = np.atleast_2d(towards / np.linalg.norm(towards, axis=-1, keepdims=True))
    return decoded((polynomial_terms(directions) @ TERMS[half])[:, None] * TINT)


def plate(folder: Path, **pose: Any) -> dict[str, Any]:  # noqa: ANN401
    write_material(folder / "map.dlmat", two_halves())
    asset = Plate(0.5, 0.4).write(folder / "plate.glb")
    material = {"precomputed": str(folder / "map.dlmat")}
    return {"asset": str(asset), "up_axis": "z", "material": material, "pose": pose}


@pytest.mark.parametrize("turn_deg", [0, 180])
def test_a_plate_under_a_lamp(objects: ObjectsRenderer, tmp_path: Path, turn_deg: float) -> None:
    """Turned about its normal, its halves change places, and the light comes from its other side."""
    turn = np.radians(turn_deg)
    pose = {"rotation_wxyz": [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]}
    document = unlit(Stage(tmp_path).document([plate(tmp_path, **pose)], [directional(LAMP, 2.0)]))
    picture = objects.linear(document, seen())
    towards = -np.array(LAMP)
    if turn_deg:
        towards[:2] *= -1
    for half, pixels in enumerate((LEFT, RIGHT) if not turn_deg else (RIGHT, LEFT)):
        wanted = 2.0 * polynomial(half, towards) / np.pi
        assert picture[pixels].reshape(-1, 3) == pytest.approx(np.tile(wanted, (300, 1)), rel=0.01)


def test_turned_a_little_and_seen_by_a_lamp_elsewhere(objects: ObjectsRenderer, tmp_path: Path) -> None:
    turn = np.radians(37)
    pose = {"rotation_wxyz": [np.cos(turn / 2), 0, 0, np.sin(turn / 2)], "translation_m": [-0.1, 0.0, 0.0]}
    way = (0.5, -0.2, -0.9)
    document = unlit(Stage(tmp_path).document([plate(tmp_path, **pose)], [directional(way, 2.0)]))
    picture = objects.linear(document, seen())
    x, y, z = -np.array(way)
    own = np.array([np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x, z])
    middle = picture[55:65, 72:78].reshape(-1, 3)  # of its right half
    assert middle == pytest.approx(np.tile(2.0 * polynomial(1, own) / np.pi, (60, 1)), rel=0.01)


def test_light_from_everywhere_meets_its_albedo(objects: ObjectsRenderer, tmp_path: Path) -> None:
    document = unlit(Stage(tmp_path).document([plate(tmp_path)], [ambient(0.5)]))
    halves = objects.linear(document, seen())
    grid = np.random.default_rng(1).normal(size=(200_000, 3))
    grid[:, 2] = np.abs(grid[:, 2])
    directions = grid / np.linalg.norm(grid, axis=1, keepdims=True)
    for half, pixels in enumerate((LEFT, RIGHT)):
        mean = polynomial(half, directions).mean(axis=0)
        found = halves[pixels].reshape(-1, 3).mean(axis=0)
        assert found == pytest.approx(0.5 * 2 * mean, rel=0.02)


def test_a_mesh_without_texture_coordinates_is_refused(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    material = plate(tmp_path)["material"]
    document = stage.document([{"id": "box", "asset": stage.asset(cube()), "material": material}], [])
    with pytest.raises(DeltalightError, match="object `box`: its material's texture needs texture coord"):
        SceneRenderer(gpu, document)


def relight_folder(folder: Path, coded: np.ndarray) -> Path:
    """A map that is the same everywhere, of these coefficients (6, 3) of codes/255."""
    folder.mkdir(exist_ok=True)
    scale, bias = np.full((6, 3), 2.0), np.full((6, 3), 0.5)
    for term, values in enumerate(coded / 2.0 + 0.5):
        codes = np.tile(np.round(255 * values).astype(np.uint8), (24, 32, 1))
        Image.fromarray(codes).save(folder / f"plane_{term}.jpg", quality=100, subsampling=0)
    info = {"type": "ptm", "colorspace": "rgb", "nplanes": 18}
    info["materials"] = [{"scale": scale.ravel().tolist(), "bias": bias.ravel().tolist()}]
    (folder / "info.json").write_text(json.dumps(info))
    return folder


CODED = np.outer([0.6, 0.12, 0.08, -0.15, 0.02, -0.2], [1.0, 0.9, 0.8])


def test_a_folder_of_relight_is_read(tmp_path: Path) -> None:
    found = read_polynomial_texture(relight_folder(tmp_path / "map", CODED))
    assert found.coefficients.shape == (6, 24, 32, 3)
    assert found.coefficients[:, 5, 7] == pytest.approx(CODED, abs=0.012)  # half a code, and JPEG's rounding


COLORS = np.array([[[200, 100, 60]] * 16 + [[80, 160, 240]] * 16] * 24, np.uint8)


def luminance_folder(folder: Path, coded: np.ndarray) -> Path:
    """A map of two colours whose luminance has these coefficients (6,) everywhere."""
    folder.mkdir(exist_ok=True)
    scale, bias = np.array([1, 1, 1, 2.0, 2.0, 3.0, 2.0, 1.5, 2.0]), np.array([0, 0, 0, *[0.5] * 6])
    terms = np.tile(np.rint(255 * (coded / scale[3:] + bias[3:])), (24, 32, 1)).astype(np.uint8)
    for number, codes in enumerate((COLORS, terms[..., :3], terms[..., 3:])):
        Image.fromarray(codes).save(folder / f"plane_{number}.jpg", quality=100, subsampling=0)
    info = {"type": "ptm", "colorspace": "lrgb", "nplanes": 9}
    info["materials"] = [{"scale": scale.tolist(), "bias": bias.tolist()}]
    (folder / "info.json").write_text(json.dumps(info))
    return folder


def test_a_folder_of_luminance_is_read(tmp_path: Path) -> None:
    """A polynomial of luminance times the colour: 1, lu, lv from one picture, lu^2, lu lv, lv^2 from the next."""
    found = read_polynomial_texture(luminance_folder(tmp_path / "map", CODED[:, 0]))
    assert found.coefficients.shape == (6, 24, 32, 3)
    for row, column in ((5, 7), (20, 30)):
        wanted = np.outer(CODED[:, 0], COLORS[row, column] / 255)
        assert found.coefficients[:, row, column] == pytest.approx(wanted, abs=0.018)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda folder: _rewritten(folder, lambda info: info.update(nplanes=18)),
            "describes no PTM of RGB or",
        ),
        (
            lambda folder: _rewritten(folder, lambda info: info["materials"][0]["bias"].pop()),
            "lacks whole sc",
        ),
        (lambda folder: (folder / "plane_2.jpg").unlink(), "plane_2.jpg cannot be read as a picture"),
        (lambda folder: Image.new("RGB", (8, 8)).save(folder / "plane_1.jpg"), "have several sizes"),
    ],
)
def test_bad_maps_of_luminance(tmp_path: Path, change: Callable[[Path], None], sentence: str) -> None:
    folder = luminance_folder(tmp_path / "map", CODED[:, 0])
    change(folder)
    with pytest.raises(DeltalightError, match=sentence):
        read_polynomial_texture(folder)


def test_a_file_holds_the_map(tmp_path: Path) -> None:
    write_material(tmp_path / "map.dlmat", two_halves())
    again = read_material(tmp_path / "map.dlmat")
    assert isinstance(again, PolynomialTexture)
    assert np.array_equal(again.coefficients, two_halves().coefficients)
    broken = two_halves().coefficients.copy()
    broken[2, 3, 4, 1] = np.nan
    write_material(tmp_path / "map.dlmat", PolynomialTexture(broken))
    with pytest.raises(DeltalightError, match="holds no material that can be drawn"):
        read_material(tmp_path / "map.dlmat")


def _without(key: str) -> Callable[[Path], None]:
    return lambda folder: _rewritten(folder, lambda info: info.pop(key))


def _rewritten(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    info = json.loads((folder / "info.json").read_text())
    change(info)
    (folder / "info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_without("type"), "describes no PTM of RGB or LRGB coefficients"),
        (_without("materials"), "lacks whole scales and biases"),
        (
            lambda folder: _rewritten(
                folder, lambda info: info["materials"][0].update(scale=[float("nan")] * 18)
            ),
            "lacks whole scales and biases",
        ),
        (lambda folder: (folder / "info.json").write_text("{"), "is not a JSON document"),
        (lambda folder: (folder / "info.json").unlink(), "cannot be read"),
        (
            lambda folder: (folder / "plane_3.jpg").write_bytes(b"JPEG?"),
            "plane_3.jpg cannot be read as a pict",
        ),
        (lambda folder: (folder / "plane_3.jpg").unlink(), "plane_3.jpg cannot be read as a picture"),
        (lambda folder: Image.new("RGB", (8, 8)).save(folder / "plane_0.jpg"), "have several sizes"),
    ],
)
def test_bad_maps(tmp_path: Path, change: Callable[[Path], None], sentence: str) -> None:
    folder = relight_folder(tmp_path / "map", CODED)
    change(folder)
    with pytest.raises(DeltalightError, match=sentence):
        read_polynomial_texture(folder)


SCALE, BIAS = np.array([2.0, 2.5, 1.5, 3.0, 2.25, 2.0]), np.array([200, 180, 120, 90, 110, 3])


def ptm_bytes(kind: str, *blocks: np.ndarray, line_end: str = "\n") -> bytes:
    """A `.ptm` file of blocks (h, w, n) of bytes whose first row is the picture's top."""
    height, width = blocks[0].shape[:2]
    numbers = (" ".join(str(number) for number in each) for each in (SCALE, BIAS))
    lines = ("PTM_1.2", f"PTM_FORMAT_{kind}", f"{width}", f"{height}", *(f"{line} " for line in numbers))
    header = "".join(line + line_end for line in lines)
    return header.encode() + b"".join(np.ascontiguousarray(block[::-1]).tobytes() for block in blocks)


def coded_block(seed: int, values: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (6, 8, values)).astype(np.uint8)


def luminance_under(block: np.ndarray, u: float, v: float) -> np.ndarray:
    """C = a0 u^2 + a1 v^2 + a2 u v + a3 u + a4 v + a5, each a = (byte - bias) scale (Malzbender and Gelb 2001)."""
    return ((block - BIAS) * SCALE) @ np.array([u * u, v * v, u * v, u, v, 1.0])


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_a_ptm_file_of_luminances_scales_its_colors(tmp_path: Path, line_end: str) -> None:
    luminance, colors = coded_block(1, 6), coded_block(2, 3)
    (tmp_path / "coin.ptm").write_bytes(ptm_bytes("LRGB", luminance, colors, line_end=line_end))
    found = read_ptm(tmp_path / "coin.ptm")
    light = np.array([0.3, -0.4, np.sqrt(0.75)])
    shown = np.tensordot(polynomial_terms(light[None])[0], found.coefficients.astype(float), 1)
    wanted = luminance_under(luminance, 0.3, -0.4)[..., None] / 255 * colors / 255
    assert shown == pytest.approx(wanted, abs=0.004)  # of half floats up to 2.9


def test_a_ptm_file_of_colors(tmp_path: Path) -> None:
    blocks = [coded_block(seed, 6) for seed in range(3)]
    (tmp_path / "coin.ptm").write_bytes(ptm_bytes("RGB", *blocks))
    found = read_ptm(tmp_path / "coin.ptm")
    light = np.array([-0.5, 0.2, np.sqrt(0.71)])
    shown = np.tensordot(polynomial_terms(light[None])[0], found.coefficients.astype(float), 1)
    wanted = np.stack([luminance_under(block, -0.5, 0.2) / 255 for block in blocks], axis=-1)
    assert shown == pytest.approx(wanted, abs=0.004)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda content: content.replace(b"PTM_1.2", b"PTM_1.1"), "not an uncompressed PTM of RGB or LRGB"),
        (lambda content: content.replace(b"_LRGB", b"_JPEG_LRGB"), "not an uncompressed PTM of RGB or LRGB"),
        (lambda content: content[:-1], r"has 431 bytes of 8x6 texels, not 432; it is damaged"),
        (lambda content: content[:40], "lacks its size, scales or biases"),
        (lambda content: content.replace(b"\n8\n", b"\n-8\n"), "lacks its size, scales or biases"),
        (lambda content: content.replace(b"2.5", b"nan"), "lacks its size, scales or biases"),
        (lambda content: content.replace(b"2.5", b"1e9"), "coefficients beyond 65504 times white"),
        (lambda content: content.replace(b"2.5", b"1e300"), "coefficients beyond 65504 times white"),
        (lambda content: b"", "not an uncompressed PTM of RGB or LRGB"),  # noqa: ARG005
    ],
)
def test_bad_ptm_files(tmp_path: Path, change: Callable[[bytes], bytes], sentence: str) -> None:
    path = tmp_path / "coin.ptm"
    path.write_bytes(change(ptm_bytes("LRGB", coded_block(1, 6), coded_block(2, 3))))
    with pytest.raises(DeltalightError, match=sentence):
        read_ptm(path)
    with pytest.raises(DeltalightError, match=r"missing\.ptm cannot be read"):
        read_ptm(tmp_path / "missing.ptm")
