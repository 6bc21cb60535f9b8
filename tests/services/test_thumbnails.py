"""Small pictures of assets: drawn once, with the asset's own colours, the right way up."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.protocol.frames import srgb_code
from deltalight.protocol.radiance_files import write_exr
from deltalight.render_server.scene.gaussian_brdf import RISE_TERMS, GaussianBrdf
from deltalight.render_server.scene.material_file import write_material
from deltalight.render_server.scene.polynomial_texture import TERMS, PolynomialTexture
from deltalight.render_server.scene.texture_stack import LAYERS, TextureStack
from deltalight.services.storage.asset_sandbox import run_limited
from deltalight.services.storage.faults import RejectedAssetError
from deltalight.services.storage.store import Store
from deltalight.services.storage.thumbnails import (
    AMBIENT_LIGHT,
    FILL,
    FILL_LIGHT,
    KEY,
    KEY_LIGHT,
    MARGIN,
    SIZE,
)
from tests.services.api_samples import UPLOAD, running_api, sentence
from tests.services.storage_samples import TETRAHEDRON, glb, trusting_probe, upload
from tests.services.test_gltf_zip import FILES, packed

pytestmark = pytest.mark.slow
PLY_HEAD = b"""ply
format ascii 1.0
element vertex 8
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 4
property list uchar int vertex_indices
end_header
"""


def wall() -> bytes:
    """Two upright squares one above the other, which face the thumbnail's camera: green above blue."""
    rows = []
    for low, color in ((0, "0 0 255"), (1, "0 255 0")):
        for height in (low, low + 1):
            rows += [f"-0.8 -0.5 {height} {color}", f"0.8 0.5 {height} {color}"]
    faces = ["3 0 1 3", "3 0 3 2", "3 4 5 7", "3 4 7 6"]
    return PLY_HEAD + "\n".join([*rows, *faces, ""]).encode()


def drawn(folder: Path, name: str, content: bytes) -> np.ndarray:
    path, out = folder / name, folder / "out.png"
    path.write_bytes(content)
    kind = {".hdr": "map", ".exr": "map", ".dlmat": "material"}.get(path.suffix, "mesh")
    run_limited(f"{kind}-thumbnail", path, name, str(out), output_bytes=1 << 20)  # type: ignore[arg-type]
    picture = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (SIZE, SIZE, 4)
    return np.asarray(picture)


def test_a_mesh_is_upright_centred_and_has_its_own_colours(tmp_path: Path) -> None:
    picture = drawn(tmp_path, "wall.ply", wall())
    covered = picture[..., 3] > 0
    rows, columns = np.nonzero(covered)
    for first, last in ((rows.min(), rows.max()), (columns.min(), columns.max())):
        assert abs(first + last - (SIZE - 1)) <= 2, "in the middle"
    assert max(np.ptp(rows), np.ptp(columns)) > 0.9 * SIZE, "as large as fits"
    blue, green, red = (picture[..., channel] for channel in range(3))
    is_green = covered & (green > 2 * blue.astype(int))
    is_blue = covered & (blue > 2 * green.astype(int))
    assert is_green.sum() > 0.3 * covered.sum()
    assert np.nonzero(is_green)[0].mean() < np.nonzero(is_blue)[0].mean(), "z is up"
    assert red[covered].max() < 30
    assert 0 < ((picture[..., 3] > 0) & (picture[..., 3] < 255)).sum() < 0.1 * covered.sum(), (
        "smooth edges only"
    )


def test_gltf_is_y_up_and_textured(tmp_path: Path) -> None:
    with Store(tmp_path / "data") as store, store.assets.receiving(1 << 20) as incoming:
        incoming.write(packed(FILES))
        asset, _ = store.assets.keep(incoming, "quad.zip")
        place = store.assets.thumbnail(asset.digest)
        drawn_ns = place.stat().st_mtime_ns
        assert store.assets.thumbnail(asset.digest).stat().st_mtime_ns == drawn_ns, "once"
    picture = cv2.imread(str(place), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    solid = picture[picture[..., 3] == 255]
    assert len(solid) > 0.3 * SIZE * SIZE, "the square stands upright and is seen from the front"
    assert solid[:, 2].min() > 100
    assert solid[:, :2].max() < 30


@pytest.mark.parametrize("key", ["baseColorTexture", "emissiveTexture"])
@pytest.mark.parametrize("how", ["plain", "transform", "second set", "mirrored"])
def test_textures_lie_where_the_file_says(tmp_path: Path, key: str, how: str) -> None:
    """Red on the left and green on the right; half a texture farther, turned round, or mirrored: the other way."""
    plate, sampler = Plate(1.0, 1.0), None
    info: dict[str, Any] = {}
    if how == "transform":
        info = {"extensions": {"KHR_texture_transform": {"offset": [0.5, 0.0]}}}
    elif how == "second set":
        plate.attributes["TEXCOORD_1"] = plate.glb.floats([(1, 1), (0, 1), (0, 0), (1, 0)])
        info = {"texCoord": 1}
    elif how == "mirrored":
        info, sampler = {"extensions": {"KHR_texture_transform": {"offset": [1.0, 0.0]}}}, {"wrapS": 33648}
    codes = np.zeros((8, 8, 3), np.uint8)
    codes[:, :4, 0] = codes[:, 4:, 1] = 255
    texture = plate.texture(codes, sampler, **info)
    if key == "emissiveTexture":
        plate.material |= {key: texture, "emissiveFactor": [1, 1, 1]}
        plate.material["pbrMetallicRoughness"] = {"baseColorFactor": [0, 0, 0, 1]}
    else:
        plate.material["pbrMetallicRoughness"] = {key: texture}
    picture = drawn(tmp_path, "plate.glb", plate.write(tmp_path / "made.glb").read_bytes())
    columns = np.nonzero((picture[..., 3] == 255).any(axis=0))[0]
    is_red = picture[..., 2].astype(int) > picture[..., 1]
    left, right = (is_red[SIZE // 2, round(np.quantile(columns, at))] for at in (0.25, 0.75))
    assert (left, right) == ((True, False) if how == "plain" else (False, True))


@pytest.mark.parametrize("is_unlit", [False, True])
def test_vertex_colours_tint_what_is_lit_and_unlit(tmp_path: Path, is_unlit: bool) -> None:
    plate = Plate(1.0, 1.0)
    plate.attributes["COLOR_0"] = plate.glb.floats([(0.0, 1.0, 0.0)] * 4)
    if is_unlit:
        plate.material["extensions"]["KHR_materials_unlit"] = {}
    picture = drawn(tmp_path, "plate.glb", plate.write(tmp_path / "made.glb").read_bytes())
    blue, green, red, _ = picture[SIZE // 2, SIZE // 2]
    assert green > 150
    assert max(blue, red) < 10


def test_a_damaged_thumbnail_is_drawn_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawings: list[str] = []

    def draw(task: str, _path: Path, _name: str, out: str, **_limits: int) -> None:
        drawings.append(task)
        Path(out).write_bytes(b"picture")

    monkeypatch.setattr("deltalight.services.storage.assets.run_limited", draw)
    with Store(tmp_path, probe=trusting_probe) as store:
        digest = upload(store, TETRAHEDRON, "t.obj").digest
        place = store.assets.thumbnail(digest)
        assert store.assets.thumbnail(digest) == place
        assert drawings == ["mesh-thumbnail"]
        place.write_bytes(b"picturf")
        assert store.assets.thumbnail(digest).read_bytes() == b"picture"
        assert len(drawings) == 2


def test_a_map_is_shown_whole_whatever_its_kind_and_brightness(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    radiance = rng.uniform(0.5, 1.5, (64, 128, 3)).astype(np.float32)
    radiance[:32, :, 2] *= 3  # the sky is blue
    hdr, exr = tmp_path / "dark.hdr", tmp_path / "bright.exr"
    cv2.imwrite(str(hdr), radiance[..., ::-1] * np.float32(1e-3))
    write_exr(exr, radiance * np.float32(1e3))
    shown = [drawn(tmp_path, f"map{path.suffix}", path.read_bytes()) for path in (hdr, exr)]
    dark, bright = (picture[SIZE // 4 : 3 * SIZE // 4].astype(int) for picture in shown)
    assert (shown[0][: SIZE // 4, :, 3] == 0).all()
    assert (dark[..., 3] == 255).all()
    assert np.abs(dark - bright).max() <= 2
    assert dark[:32, :, 0].mean() > dark[-32:, :, 0].mean() + 20


def test_a_measured_paint_is_a_lit_ball(tmp_path: Path) -> None:
    """A diffuse one shows the closed form where the key light meets it head-on; a lobe adds a highlight."""
    base = np.array([0.5, 0.2, 0.1])
    matt = GaussianBrdf(base, np.zeros(0), np.zeros((0, RISE_TERMS, 3)))
    coated = GaussianBrdf(base, np.array([0.15]), np.full((1, RISE_TERMS, 3), 0.05))
    pictures = []
    for name, made in (("matt", matt), ("coated", coated)):
        write_material(tmp_path / name, made)
        pictures.append(drawn(tmp_path, f"{name}.dlmat", (tmp_path / name).read_bytes()))
    way = KEY / np.linalg.norm(KEY)
    column, row = (
        round((SIZE / 2) * (1 + sign * part / MARGIN) - 0.5) for sign, part in ((1, way[0]), (-1, way[1]))
    )
    fill = FILL_LIGHT * max(0.0, float(way @ FILL) / float(np.linalg.norm(FILL)))
    expected = srgb_code((base * (KEY_LIGHT + AMBIENT_LIGHT + fill)).astype(np.float32)[None])[0]
    assert pictures[0][row, column, 2::-1] / 255 == pytest.approx(expected, abs=0.01)
    assert pictures[0][0, 0, 3] == 0
    assert (pictures[1].astype(int) - pictures[0]).max() > 40


def test_a_polynomial_texture_map_is_upright_and_keeps_its_shape(tmp_path: Path) -> None:
    coefficients = np.zeros((TERMS, 8, 16, 3), np.float16)
    coefficients[0, :4, :, 0] = coefficients[0, 4:, :, 2] = 0.8  # red above blue
    write_material(tmp_path / "map", PolynomialTexture(coefficients))
    picture = drawn(tmp_path, "map.dlmat", (tmp_path / "map").read_bytes())
    assert (picture[: SIZE // 4 - 1, :, 3] == 0).all()
    assert (picture[SIZE // 4 + 1 : 3 * SIZE // 4 - 1, :, 3] == 255).all()
    assert picture[SIZE // 3, SIZE // 2, 2] > 100 > picture[SIZE // 3, SIZE // 2, 0]
    assert picture[2 * SIZE // 3, SIZE // 2, 0] > 100 > picture[2 * SIZE // 3, SIZE // 2, 2]


def test_a_texture_stack_is_lit_by_its_layers(tmp_path: Path) -> None:
    """Under the thumbnails' lights, which are not at the horizon: what its lowest layers show is not seen."""
    layers = np.zeros((LAYERS, 8, 8, 3), np.float16)
    layers[:2, ..., 2] = layers[-8:, :4, :, 0] = 0.8  # blue where light grazes, else red above black
    write_material(tmp_path / "stack", TextureStack(layers))
    picture = drawn(tmp_path, "stack.dlmat", (tmp_path / "stack").read_bytes())
    assert (picture[..., 3] == 255).all()
    assert picture[SIZE // 4, SIZE // 2, 2] > 2 * picture[3 * SIZE // 4, SIZE // 2, 2]
    assert picture[SIZE // 4, SIZE // 2, 2] > 2 * picture[SIZE // 4, SIZE // 2, 0]


def test_a_mesh_that_lies_or_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RejectedAssetError, match=r"flat\.obj has no triangle with an area"):
        drawn(tmp_path, "flat.obj", b"v 0 0 0\nv 1 0 0\nf 1 1 2\n")
    with pytest.raises(RejectedAssetError, match=r"bad\.glb"):
        drawn(tmp_path, "bad.glb", glb({"asset": {"version": "2.0"}}))


def test_rest_gives_it_to_browsers(tmp_path: Path) -> None:
    with running_api(tmp_path) as api:
        asset = api.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD).json()["asset"]
        answer = api.client.get(f"/assets/{asset}/thumbnail.png")
        assert (answer.status_code, answer.headers["content-type"]) == (200, "image/png")
        assert "immutable" in answer.headers["cache-control"]
        picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        assert picture.shape == (SIZE, SIZE, 4)
        assert "no asset" in sentence(api.client.get(f"/assets/{'0' * 64}/thumbnail.png"), 404)
        api.client.delete(f"/assets/{asset}").raise_for_status()
        assert sorted(path.name for path in (tmp_path / "assets").iterdir()) == [".incoming"]
