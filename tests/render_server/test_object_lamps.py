"""Lamps that come with a model (KHR_lights_punctual): light of the objects' side alone, in closed forms."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import sizes_bytes
from deltalight.render_server.passes.shadow_maps import ShadowMapAtlas, atlas_bytes
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.mesh_loading import load_asset
from tests.render_server.gltf_samples import HALF
from tests.render_server.lpv_scenes import dlpv, graph_of, injected_flux
from tests.render_server.scenes import GREY, Fields, Stage, ambient, fields_of, floor, frame, sphere_light
from tests.render_server.test_aroof import aroof

pytestmark = pytest.mark.usefixtures("clean_gl")
METHODS: dict[str, dict[str, Any]] = {
    "exact": {},
    "differential": {"name": "differential"},
    "paper": {"operator": "paper"},
    "dlpv": {"name": "dlpv"},
}
SKY = 0.4
ALBEDO = float(decode_lut(None)[GREY, 0]) / SKY
POINT: dict[str, Any] = {"type": "point", "intensity": 0.08, "color": [1, 0.5, 0.25]}
COLOR = np.array([1, 0.5, 0.25])
LAMP = np.array([0.05, 0.0, 0.25])
HOLDER = {"translation": [0, 0.9, 0.03]}  # of a plate that is not in the way


def lamp_model(
    path: Path, light: dict[str, Any], lamp: dict[str, Any], plate: dict[str, Any], edge: float = 0.02
) -> dict[str, Any]:
    """An object: a plate and a lamp at nodes of their own; a lamp without rotation shines down."""
    made = Plate(edge, edge)
    made.material |= {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0}}
    extension = "KHR_lights_punctual"
    made.glb.document |= {"extensionsUsed": [extension], "extensions": {extension: {"lights": [light]}}}
    made.glb.add("nodes", {**lamp, "extensions": {extension: {"light": 0}}})
    return {"asset": str(made.write(path, plate)), "up_axis": "z"}


class Lit:
    """A frame's fields, its linear picture, and where the floor is seen."""

    def __init__(self, gpu: GpuContext, stage: Stage, objects: list[dict[str, Any]], **method: Any) -> None:  # noqa: ANN401
        lights = [ambient(SKY), *method.pop("lights", ())]
        if method.get("name") == "dlpv":
            document = dlpv(stage.document(objects, lights, floor()), **method)
        elif method.get("name") == "aroof":
            document = aroof(stage.document(objects, lights, floor()))
        else:
            document = stage.document(objects, lights, floor(), **method)
        renderer = SceneRenderer(gpu, document, with_linear=True)
        shown = renderer.render(frame(depth=None))
        assert shown.linear is not None
        self.codes, self.linear = shown.color, shown.linear
        self.fields: Fields = fields_of(renderer)
        self.sent = 0.0  # into the volume due to the objects and their lamps, W in the picture's units
        if method.get("name") == "dlpv":
            self.sent = float(injected_flux(graph_of(renderer), "inject change")[..., 0].sum())
        self.notices = [each for each in renderer.notices if "lamp.glb" in each]
        renderer.release()
        place = self.fields.position
        self.on_floor = (place[..., 3] > 0) & (self.fields.matte == 0) & (np.abs(place[..., 2]) < 1e-3)

    def around(self, radius: float = 0.25) -> np.ndarray:
        away = np.linalg.norm(self.fields.position[..., :2] - LAMP[:2], axis=-1)
        return self.on_floor & (away < radius)


def irradiance_by(places: np.ndarray, intensity: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """I cos / d^2 of a lamp over the floor z = 0, the cosine of its angle from straight down, and the distance."""
    d = LAMP - places[:, :3]
    distance = np.linalg.norm(d, axis=1)
    cosine = d[:, 2] / distance
    return intensity * cosine / distance**2, cosine, distance


@pytest.mark.parametrize("name", METHODS)
def test_a_point_lights_the_real_floor_of_the_picture(gpu: GpuContext, tmp_path: Path, name: str) -> None:
    """rho / pi I cos / d^2 is added to what the camera saw, rho by the light that the method thinks it saw."""
    model = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": LAMP.tolist()}, HOLDER)
    lit = Lit(gpu, Stage(tmp_path), [model], **METHODS[name])
    at = lit.around()
    expected = irradiance_by(lit.fields.position[at], POINT["intensity"])[0][:, None] * COLOR
    gained = lit.fields.direct_rho[at] - lit.fields.direct_mu[at]
    assert gained == pytest.approx(expected, rel=2e-3, abs=1e-4)
    added = lit.linear[at] - ALBEDO * SKY
    before = (lit.fields.direct_mu + lit.fields.cones_mu)[at]
    assert before == pytest.approx(np.pi * SKY, rel=0.05)
    assert added == pytest.approx(ALBEDO * SKY * expected / before, rel=0.015, abs=3e-3)
    assert not lit.notices


def test_the_volume_of_the_papers_dlpv_holds_a_lamps_direct_light(gpu: GpuContext, tmp_path: Path) -> None:
    """Where the volume is, the floor gains what the lamp sends."""
    above = {"translation": np.add(LAMP, (0, 0, 0.03)).tolist()}  # the volume is the plate's
    model = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": LAMP.tolist()}, above)
    lit = Lit(gpu, Stage(tmp_path), [model], name="dlpv", operator="paper")
    at = lit.around(0.15)
    expected = irradiance_by(lit.fields.position[at], POINT["intensity"])[0][:, None] * COLOR
    assert lit.linear[at] - ALBEDO * SKY == pytest.approx(ALBEDO / np.pi * expected, rel=0.01)


def test_aroof_adds_a_lamps_direct_light(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path))
    model = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": LAMP.tolist()}, HOLDER)
    lit = Lit(gpu, Stage(tmp_path), [model], name="aroof")
    at = lit.around()
    expected = irradiance_by(lit.fields.position[at], POINT["intensity"])[0][:, None] * COLOR
    assert lit.linear[at] - ALBEDO * SKY == pytest.approx(ALBEDO / np.pi * expected, rel=0.015)


def drawn_lamp(gpu: GpuContext, folder: Path, light: dict[str, Any], **node: Any) -> tuple[np.ndarray, ...]:  # noqa: ANN401
    """The light gained around the lamp, and closed forms there."""
    model = lamp_model(folder / "lamp.glb", light, {"translation": LAMP.tolist(), **node}, HOLDER)
    lit = Lit(gpu, Stage(folder), [model])
    at = lit.around()
    gained = (lit.fields.direct_rho[at] - lit.fields.direct_mu[at])[:, 0]
    return gained, *irradiance_by(lit.fields.position[at], 1.0)


def test_a_spot_falls_off_between_its_cones(gpu: GpuContext, tmp_path: Path) -> None:
    """By the square of what its cosine is between those of both cones."""
    cones = {"innerConeAngle": 0.2, "outerConeAngle": 0.6}
    gained, by_point, cosine, _ = drawn_lamp(gpu, tmp_path, {"type": "spot", "intensity": 0.1, "spot": cones})
    part = np.clip((cosine - np.cos(0.6)) / (np.cos(0.2) - np.cos(0.6)), 0, 1) ** 2
    assert gained == pytest.approx(0.1 * part * by_point, rel=3e-3, abs=2e-4)
    assert (part == 0).any()
    assert (part == 1).any()


def test_a_range_ends_the_light(gpu: GpuContext, tmp_path: Path) -> None:
    gained, by_point, _, distance = drawn_lamp(
        gpu, tmp_path, {"type": "point", "intensity": 0.1, "range": 0.3}
    )
    window = np.clip(1 - (distance / 0.3) ** 4, 0, 1)
    assert gained == pytest.approx(0.1 * window * by_point, rel=3e-3, abs=2e-4)
    assert (window == 0).any()


def test_a_distant_light_shines_along_its_node(gpu: GpuContext, tmp_path: Path) -> None:
    """Turned by 60 degrees about x: E cos 60. Intensity is in lux of the camera's scale."""
    turn = [np.sin(np.radians(30)), 0, 0, np.cos(np.radians(30))]
    gained, *_ = drawn_lamp(gpu, tmp_path, {"type": "directional", "intensity": 0.6}, rotation=turn)
    assert np.median(gained) == pytest.approx(0.3, rel=3e-3)
    assert np.mean(np.abs(gained - 0.3) < 1e-3) > 0.95


@pytest.mark.parametrize("name", METHODS)
def test_an_object_shadows_its_own_lamp(gpu: GpuContext, tmp_path: Path, name: str) -> None:
    """A plate of 6 cm halfway between lamp and floor: a shadow of 12 cm below, in light."""
    below = {"translation": [LAMP[0], 0, LAMP[2] / 2]}
    model = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": LAMP.tolist()}, below, edge=0.06)
    lit = Lit(gpu, Stage(tmp_path), [model], **METHODS[name], volume_edge_m=0.4)
    apart = np.abs(lit.fields.position[..., :2] - LAMP[:2]).max(axis=-1)
    gained = lit.fields.direct_rho - lit.fields.direct_mu
    inside, outside = lit.on_floor & (apart < 0.045), lit.on_floor & (apart > 0.08) & (apart < 0.15)
    expected = irradiance_by(lit.fields.position[outside], POINT["intensity"])[0]
    is_cone = name == "paper"  # its shadows are cones through voxels of 12 mm
    assert gained[inside][:, 0] == pytest.approx(0, abs=0.25 if is_cone else 1e-3)
    assert gained[outside][:, 0] == pytest.approx(expected, rel=0.25 if is_cone else 3e-3)


def test_a_lamp_lights_its_object(gpu: GpuContext, tmp_path: Path) -> None:
    """A white plate straight below the lamp gains as from a light of the scene: I / (pi d^2), and bounces."""
    at = {"translation": LAMP.tolist()}, {"translation": [LAMP[0], 0, 0.05]}
    model = lamp_model(tmp_path / "lamp.glb", {**POINT, "color": [1, 1, 1]}, *at, edge=0.1)
    off, scenes = {**model, "lamps": 0.0}, sphere_light(tuple(LAMP), POINT["intensity"])
    lit, by_scene, dark = (
        Lit(gpu, Stage(tmp_path), [each], lights=lights)
        for each, lights in ((model, ()), (off, (scenes,)), (off, ()))
    )
    shown = lit.fields.matte == 1
    gained, expected = ((each.linear - dark.linear)[shown] for each in (lit, by_scene))
    assert gained == pytest.approx(expected, rel=0.03)
    assert np.median(gained) == pytest.approx(POINT["intensity"] / np.pi / 0.2**2, rel=0.1)


def test_lamps_that_are_off_leave_every_bit(gpu: GpuContext, tmp_path: Path) -> None:
    """As the same model without lamps, and half of the factor is half of the light."""
    lamp = {"translation": LAMP.tolist()}
    lit, off = lamp_model(tmp_path / "lamp.glb", POINT, lamp, HOLDER), {"lamps": 0.0}
    plain = Plate(0.02, 0.02)
    plain.material |= {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0}}
    dark = {"asset": str(plain.write(tmp_path / "plain.glb", HOLDER)), "up_axis": "z"}
    full, half, none, without = (
        Lit(gpu, Stage(tmp_path), [each]) for each in (lit, {**lit, "lamps": 0.5}, {**lit, **off}, dark)
    )
    assert np.array_equal(none.codes, without.codes)
    assert np.array_equal(none.linear, without.linear)
    at = full.around()
    gained = [(each.fields.direct_rho - each.fields.direct_mu)[at] for each in (full, half)]
    assert gained[1] == pytest.approx(gained[0] / 2, rel=2e-3, abs=1e-5)


@dataclass(frozen=True)
class Spot:
    """Of a lamp whose edge is narrow; it shines down, or up."""

    height_m: float
    intensity: float
    angle_rad: float
    is_upward: bool = False
    plate_edge_m: float = 0.1

    @property
    def flux(self) -> float:
        return self.intensity * 2 * np.pi * (1 - np.cos(self.angle_rad + 0.005))


def shone(gpu: GpuContext, folder: Path, name: str, of: Spot, plate: dict[str, Any]) -> tuple[Lit, Lit, Lit]:
    """Lit by a narrow-edged spot of an object, by the same spot of the scene, and by neither."""
    outer = of.angle_rad + 0.01
    cones = {"innerConeAngle": of.angle_rad, "outerConeAngle": outer}
    node = {
        "translation": [LAMP[0], 0, of.height_m],
        "rotation": [1, 0, 0, 0] if of.is_upward else [0, 0, 0, 1],
    }
    model = lamp_model(
        folder / "lamp.glb",
        {"type": "spot", "intensity": of.intensity, "spot": cones},
        node,
        plate,
        edge=of.plate_edge_m,
    )
    same = {
        "type": "spot",
        "position_m": node["translation"],
        "direction": [0, 0, 1 if of.is_upward else -1],
        "intensity": of.intensity,
        "radius_m": 0,
        "angle_deg": 2 * np.degrees(outer),
        "blend": 0.01 / outer,
    }
    settings = {**METHODS[name], "volume_edge_m": 0.7}
    return (
        Lit(gpu, Stage(folder), [model], **settings),
        Lit(gpu, Stage(folder), [{**model, "lamps": 0}], lights=(same,), **settings),
        Lit(gpu, Stage(folder), [{**model, "lamps": 0}], **settings),
    )


@pytest.mark.parametrize("name", METHODS)
def test_what_a_lamp_lights_of_its_object_lights_the_floor(
    gpu: GpuContext, tmp_path: Path, name: str
) -> None:
    """It shines up at a white plate, whose light comes down: the floor gains what a light of the scene brings."""
    spot = Spot(0.1, 0.4, 0.24, is_upward=True, plate_edge_m=0.16)
    lit, by_scene, dark = shone(gpu, tmp_path, name, spot, {"translation": [LAMP[0], 0, 0.3]})
    at = lit.on_floor & (np.linalg.norm(lit.fields.position[..., :2] - LAMP[:2], axis=-1) < 0.05)
    gained, expected = ((each.fields.cones_rho - dark.fields.cones_rho)[at] for each in (lit, by_scene))
    assert gained.mean() == pytest.approx(expected.mean(), rel=0.05)
    if name in ("exact", "differential"):
        assert gained.mean() == pytest.approx(spot.flux / np.pi / 0.3**2, rel=0.25)


@pytest.mark.parametrize("name", METHODS)
def test_what_a_lamp_lights_of_the_room_lights_its_object(gpu: GpuContext, tmp_path: Path, name: str) -> None:
    """It shines down at the floor, whose light falls on a plate behind.

    By the form factor of a small source; in the volume of DLPV, the light that the floor sends is counted too.
    """
    upright = {"translation": [LAMP[0], 0.12, 0.09], "rotation": [HALF, 0, 0, HALF]}  # faces -y
    spot = Spot(0.15, 0.3, 0.3)
    lit, _, dark = shone(gpu, tmp_path, name, spot, upright)
    shown = (lit.fields.matte == 1) & (dark.fields.matte == 1)
    gained = float(np.median((lit.fields.on_object - dark.fields.on_object)[shown]))
    far = np.hypot(0.09, 0.12)
    expected = ALBEDO * spot.flux / np.pi / far**2 * (0.09 / far) * (0.12 / far)
    assert gained == pytest.approx(expected, rel=0.35)
    if name == "dlpv":
        assert lit.sent - dark.sent == pytest.approx(ALBEDO * spot.flux, rel=0.03)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"type": "lava"}, "neither directional nor a point nor a spot"),
    ({"type": "point", "intensity": -1}, "makes no light"),
    ({"type": "point", "color": [1, 1]}, "makes no light"),
    ({"type": "point", "range": 0}, "makes no light"),
    ({"type": "point", "range": 1e-200}, "makes no light"),
    ({"type": "point", "intensity": "bright"}, "lamp.glb"),
    ({"type": "point", "intensity": float("inf")}, "lamp.glb"),
    ({"type": "spot", "spot": {"innerConeAngle": 0.7, "outerConeAngle": 0.6}}, "not within its outer one"),
]


@pytest.mark.parametrize(("light", "sentence"), BAD)
def test_lamps_that_make_no_light_are_refused_in_a_sentence(
    tmp_path: Path, light: dict[str, Any], sentence: str
) -> None:
    model = lamp_model(tmp_path / "lamp.glb", light, {}, HOLDER)
    with pytest.raises(DeltalightError, match=sentence):
        load_asset(Path(model["asset"]))


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
def test_a_node_of_scale_0_leaves_lights_without_direction_dark(
    gpu: GpuContext, tmp_path: Path, kind: str
) -> None:
    """A sentence says so; nothing else of the picture is lost. A point needs no direction."""
    flat = {"translation": LAMP.tolist(), "scale": [0, 0, 0]}
    model = lamp_model(tmp_path / "lamp.glb", {**POINT, "type": kind}, flat, HOLDER)
    lit, dark = (Lit(gpu, Stage(tmp_path), [{**model, "lamps": factor}]) for factor in (1, 0))
    assert np.isfinite(lit.linear).all()
    if kind == "point":
        assert not lit.notices
        assert (lit.linear - dark.linear)[lit.around()].mean() > 0.01
    else:
        (sentence,) = lit.notices
        assert "dark while the scale of their nodes is 0 along z (node 0)" in sentence
        assert np.array_equal(lit.codes, dark.codes)


def test_more_lamps_than_a_scene_may_list_are_refused(gpu: GpuContext, tmp_path: Path) -> None:
    """In one file, and of all objects together, but for those whose lamps are off."""
    model = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": LAMP.tolist()}, HOLDER)
    objects = [{**model, "id": f"lamp{number}"} for number in range(65)]
    with pytest.raises(DeltalightError, match="bring 65 lamps, more than 64; switch some off"):
        SceneRenderer(gpu, Stage(tmp_path).document(objects, [], floor()))
    objects[7]["lamps"] = 0
    SceneRenderer(gpu, Stage(tmp_path).document(objects, [], floor())).release()


def test_a_spot_of_a_hemisphere_in_single_precision(gpu: GpuContext, tmp_path: Path) -> None:
    """float32(pi) / 2 lies above pi / 2."""
    cones = {"innerConeAngle": 0.0, "outerConeAngle": float(np.float32(np.pi)) / 2}
    gained, by_point, cosine, _ = drawn_lamp(gpu, tmp_path, {"type": "spot", "intensity": 0.1, "spot": cones})
    assert gained == pytest.approx(0.1 * cosine**2 * by_point, rel=3e-3, abs=2e-4)


@pytest.mark.parametrize("name", METHODS)
def test_the_brightest_lamp_makes_white_and_not_nothing(gpu: GpuContext, tmp_path: Path, name: str) -> None:
    """54 kcd, as programs export a lamp of 1000 W; its object is near it."""
    light = {"type": "point", "intensity": 5.4e4}
    model = lamp_model(
        tmp_path / "lamp.glb", light, {"translation": LAMP.tolist()}, {"translation": [0, 0, 0.2]}, 0.1
    )
    lit = Lit(gpu, Stage(tmp_path), [model], **METHODS[name])
    assert np.isfinite(lit.linear).all()
    assert np.isfinite(lit.fields.direct_rho).all()
    assert (lit.codes[lit.around(0.1)] == 255).mean() > 0.2  # the plate's shadow is dark


def test_lamps_of_a_resting_object_stay_the_same_lights_while_another_moves(
    gpu: GpuContext, tmp_path: Path
) -> None:
    """So nothing about them is found again."""
    stage = Stage(tmp_path)
    lamp = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": LAMP.tolist()}, HOLDER)
    other = {**lamp_model(tmp_path / "other.glb", POINT, {}, HOLDER), "lamps": 0}

    def with_other(x: float, intensity: float = 1.0) -> SceneDocument:
        moved = {**other, "id": "other", "pose": {"translation_m": [x, 0, 0]}}
        return stage.document([{**lamp, "id": "lamp", "lamps": intensity}, moved], [ambient(SKY)], floor())

    renderer = SceneRenderer(gpu, with_other(0.0))
    seen = []
    for document in (with_other(0.0), with_other(0.1), with_other(0.1, 0.5)):
        renderer.set_scene(document)
        renderer.render(frame(depth=None))
        seen.append(graph_of(renderer)["object lamps"])
    renderer.release()
    assert seen[1][0] is seen[0][0]
    assert seen[2][0].intensity == pytest.approx(0.5 * seen[0][0].intensity)


@pytest.mark.parametrize("tiles", [1, 6, 7])
def test_an_atlas_takes_what_is_stated(gpu: GpuContext, tiles: int) -> None:
    atlas = ShadowMapAtlas(gpu, tiles, 36)
    assert atlas_bytes(tiles, 36) == sum(sizes_bytes([atlas]))
    atlas.release()


@pytest.mark.parametrize(
    ("name", "kind", "views"),
    [("dvct", "point", (6, 6)), ("dvct", "directional", (1, 4)), ("differential", "point", (6, 6))],
)
def test_maps_of_lamps_take_no_more_than_is_stated(
    gpu: GpuContext, tmp_path: Path, name: str, kind: str, views: tuple[int, int]
) -> None:
    """A point has up to six maps of the room and of the objects each, a distant light one, and of groups of objects
    four."""
    model = lamp_model(tmp_path / "lamp.glb", {**POINT, "type": kind}, {"translation": [0, 0, 0.05]}, HOLDER)
    renderer = SceneRenderer(gpu, Stage(tmp_path).document([model], [], floor(), name=name))
    renderer.render(frame(depth=None))
    held = sum(each.size_bytes for each in graph_of(renderer).report() if "shadow maps" in each.name)
    (sentence,) = [each for each in renderer.notices if "shadow maps" in each]
    renderer.release()
    stated = -(-sum(atlas_bytes(count, 256) for count in views) // 10**6)
    assert sentence == f"shadow maps of the objects' lamps (1): up to {stated} MB"
    assert 0 < held <= 1e6 * stated


def test_without_lamps_nothing_is_stated(gpu: GpuContext, tmp_path: Path) -> None:
    model = lamp_model(tmp_path / "lamp.glb", POINT, {"translation": [0, 0, 0.05]}, HOLDER)
    renderer = SceneRenderer(gpu, Stage(tmp_path).document([{**model, "lamps": 0}], [ambient(SKY)], floor()))
    assert not any("shadow maps" in each for each in renderer.notices)
    renderer.release()


def test_lights_whose_maps_no_texture_holds_are_refused_with_the_size_that_fits(
    gpu: GpuContext, tmp_path: Path
) -> None:
    lamps = [sphere_light((0.1 * nth, 0.0, 0.3)) for nth in range(12)]
    limit = int(gpu.ctx.info["GL_MAX_TEXTURE_SIZE"])
    stage = Stage(tmp_path)
    plate = stage.virtual(trimesh.creation.box((0.1, 0.1, 0.1)))
    renderer = SceneRenderer(gpu, stage.document([plate], lamps, floor(), rsm_size=4096))
    with pytest.raises(DeltalightError, match=rf"no more than {limit}; set `rsm_size` to \d+ or less"):
        renderer.render(frame(depth=None))
    renderer.release()
