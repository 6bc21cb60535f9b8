"""Scene documents: defaults, faults in one sentence, assets, transforms."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument, load_scene, parse_scene, scene_json_schema
from deltalight.protocol.scene_lights import AmbientLight, DirectionalLight, SphereLight
from deltalight.protocol.scene_method import DvctMethod, NoneMethod
from deltalight.protocol.scene_objects import ModelGeometry, PrecomputedMaterial


def an_object(**changes: object) -> dict[str, Any]:
    return {"objects": [{"asset": "a.ply", **changes}]}


def lights(**light: object) -> dict[str, Any]:
    return {"lights": {"manual": [light]}}


FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"ligths": {}}, "unknown key `ligths`; the nearest known key is `lights`"),
    (
        lights(type="sphere", colour=[1, 1, 1]),
        r"`lights\.manual\[0\]\.colour`; the nearest known key is `color_linear`",
    ),
    (lights(type="sphre"), r"`lights\.manual\[0\]` names the unknown kind `sphre`; the nearest is `sphere`"),
    (lights(type=["a"]), r"`lights\.manual\[0\]` names the unknown kind"),
    (lights(type="sphere", intensity=-1), r"`lights\.manual\[0\]\.intensity` is wrong: .*0 \(given: -1\)"),
    (lights(type="directional", irradiance=-0.1), r"lights\.manual\[0\]\.irradiance"),
    (lights(type="rectangle", radiance=float("inf")), r"lights\.manual\[0\]\.radiance"),
    (lights(type="ambient", color_linear=[1, -1, 1]), r"lights\.manual\[0\]\.color_linear\[1\]"),
    (lights(type="spot", direction=[0, 0, 0]), r"lights\.manual\[0\]\.direction.*zero"),
    (lights(type="rectangle", axis_v_m=[1, 0, 0]), r"lights\.manual\[0\].*span an area"),
    ({"lights": {"manual": [7]}}, r"lights\.manual\[0\]"),
    ({"lights": {"mode": "environment"}}, r"environment\.map"),
    ({"lights": {"registration": "aut"}}, r"lights\.registration.*auto"),
    ({"lights": {"registration": [1, 0, 1]}}, r"lights\.registration\[1\]"),
    ({"objects": [{}]}, r"`objects\[0\]\.asset` is missing"),
    ({"objects": 5}, "objects"),
    ({"objects": [{"asset": "a", "id": "x"}, {"asset": "b", "id": "x"}]}, "two objects have the id `x`"),
    (an_object(frame="marker"), r"objects\[0\]\.frame"),
    (
        an_object(material={"rough": 1}),
        r"`objects\[0\]\.material\.rough`; the nearest known key is `roughness`",
    ),
    (an_object(material={"roughness": 1.5}), r"objects\[0\]\.material\.roughness"),
    (an_object(pose={"rotation_wxyz": [0, 0, 0, 0]}), r"objects\[0\]\.pose\.rotation_wxyz.*zero"),
    (an_object(pose={"translation_m": [0, 1e5, 0]}), r"objects\[0\]\.pose\.translation_m\[1\].*10000"),
    (an_object(pose={"translation_m": [0, float("nan"), 0]}), "finite"),
    (an_object(pose={"translation_m": [0, 0]}), r"objects\[0\]\.pose\.translation_m\[2\]` is missing"),
    (an_object(pose={"scale": 0}), r"objects\[0\]\.pose\.scale"),
    ({"real": {"geometry": "deph"}}, r"real\.geometry.*depth"),
    ({"real": {"geometry": {"modl": "a"}}}, r"`real\.geometry\.modl`; the nearest known key is `model`"),
    (
        {"real": {"surfaces": [{"region": {"plane": {}, "box": {}}}]}},
        r"real\.surfaces\[0\]\.region.*exactly one",
    ),
    (
        {
            "real": {
                "surfaces": [{"region": {"sheet": {"middle_m": [0, 0], "size_m": [1, 1]}}, "specular": 1}]
            }
        },
        r"real\.surfaces\[0\].*a sheet is diffuse: leave out roughness, metallic, specular and albedo",
    ),
    ({"real": {"surfaces": [{"region": {"sheet": {"middle_m": [0, 0], "size_m": [1, 0]}}}]}}, "size_m"),
    ({"real": {"surfaces": [{"region": {"box": {"min_m": [1, 0, 0], "max_m": [0, 1, 1]}}}]}}, "min_m"),
    ({"objects": [{"id": "..", "asset": "a.ply"}]}, r"objects\[0\]\.id` is wrong: .*choose another name"),
    ({"objects": "knot"}, r"`objects` is wrong: must be a list \(given: 'knot'\)"),
    ({"objects": ["knot"]}, r"`objects\[0\]` is wrong: must be an object with keys and values"),
    ({"method": {"volume_size": 65}}, r"method\.volume_size.*multiple of 8"),
    ({"method": {"name": "dvct", "volume_size": 520}}, r"method\.volume_size.*512"),
    ({"method": {"name": "dcvt"}}, "`method` names the unknown kind `dcvt`; the nearest is `dvct`"),
    ({"method": {"name": "exact"}}, "`exact` is a short name .* write {name: dvct, operator: exact}"),
    ({"method": {"name": "dlpv-paper"}}, "write {name: dlpv, operator: paper}"),
    ({"method": {"operater": "exact"}}, r"`method\.operater`; the nearest known key is `operator`"),
    ({"method": {"name": "none", "operator": "exact"}}, r"unknown key `method\.operator`"),
    ({"method": {"cone_scale": 3}}, r"method\.cone_scale"),
    ({"method": "dvct"}, "method"),
    ({"output": {"width": 4}}, r"output\.width"),
    ({"revision": -1}, "revision"),
]


@pytest.mark.parametrize(("document", "message"), FAULTS, ids=[message for _, message in FAULTS])
def test_faults_are_one_sentence_with_the_place(document: dict[str, Any], message: str) -> None:
    with pytest.raises(DeltalightError, match=message) as caught:
        parse_scene(document, "room.json")
    sentence = str(caught.value)
    assert sentence.startswith("room.json: ")
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert len(sentence) < 400


def test_every_key_but_an_objects_asset_has_a_default() -> None:
    scene = parse_scene({"objects": [{"asset": "a.ply"}, {"asset": "b.glb"}], "real": {"surfaces": [{}]}})
    assert [item.id for item in scene.objects] == ["object0", "object1"]
    assert [item.resolved_up_axis for item in scene.objects] == ["z", "y"]
    assert scene.real.geometry == "depth"
    assert scene.real.surfaces[0].region.plane is not None
    assert isinstance(scene.method, DvctMethod)
    assert scene.method.resolved_composition == "ratio"
    assert scene.lights.mode == "manual"
    assert {type(light) for light in scene.lights.manual} == {DirectionalLight, AmbientLight}
    assert not parse_scene({"lights": {}}).lights.manual
    for kind in ("directional", "sphere", "spot", "rectangle", "ambient"):
        assert parse_scene(lights(type=kind)).lights.manual[0].type == kind
    assert isinstance(parse_scene(lights(intensity=2)).lights.manual[0], SphereLight)


def test_registration_follows_the_mode() -> None:
    environment = {"mode": "environment", "environment": {"map": "sky.hdr"}}
    assert parse_scene({"lights": environment}).lights.resolved_registration == "auto"
    assert parse_scene({"lights": {"mode": "fisheye"}}).lights.resolved_registration == "auto"
    assert parse_scene({}).lights.resolved_registration == (1.0, 1.0, 1.0)
    assert parse_scene({"lights": {"registration": "auto"}}).lights.resolved_registration == "auto"
    assert parse_scene({"lights": {"registration": [1, 2, 3]}}).lights.resolved_registration == (1, 2, 3)


def test_the_papers_operator_composes_additively_unless_told() -> None:
    paper = parse_scene({"method": {"operator": "paper"}}).method
    assert isinstance(paper, DvctMethod)
    assert paper.resolved_composition == "additive"
    told = parse_scene({"method": {"operator": "paper", "composition": "ratio"}}).method
    assert isinstance(told, DvctMethod)
    assert told.resolved_composition == "ratio"
    assert isinstance(parse_scene({"method": {"name": "none"}}).method, NoneMethod)


@pytest.mark.parametrize(
    ("method", "shadow"),
    [
        ({}, "map"),
        ({"operator": "paper"}, "cone"),
        ({"operator": "paper", "shadow": "map"}, "map"),
        ({"shadow": "cone"}, "cone"),
        ({"operator": "paper", "shadow": None}, "cone"),
    ],
)
def test_the_papers_operator_casts_shadow_cones_unless_told(method: dict[str, Any], shadow: str) -> None:
    parsed = parse_scene({"method": method}).method
    assert isinstance(parsed, DvctMethod)
    assert parsed.resolved_shadow == shadow


def test_directions_and_quaternions_are_normalised_once() -> None:
    scene = parse_scene(
        {**lights(type="spot", direction=[0, 3, 4]), **an_object(pose={"rotation_wxyz": [2, 0, 0, 2]})}
    )
    light = scene.lights.manual[0]
    assert light.type == "spot"
    assert light.direction == pytest.approx((0, 0.6, 0.8))
    assert np.linalg.norm(scene.objects[0].pose.rotation_wxyz) == pytest.approx(1)
    again = parse_scene(json.loads(scene.canonical_json()))
    assert again == scene
    assert again.canonical_json() == scene.canonical_json()


def test_pose_turns_scales_and_moves() -> None:
    half = float(np.sqrt(0.5))
    pose = {"translation_m": [1, 2, 3], "rotation_wxyz": [half, 0, 0, half], "scale": 2}
    z_up = parse_scene(an_object(pose=pose)).objects[0].world_from_object()
    # +90 degrees about z: x becomes y.
    assert z_up @ [1, 0, 0, 1] == pytest.approx([1, 4, 3, 1])
    y_up = parse_scene(an_object(pose=pose, up_axis="y")).objects[0].world_from_object()
    assert y_up @ [0, 1, 0, 1] == pytest.approx(z_up @ [0, 0, 1, 1])
    assert y_up @ [0, 0, 1, 1] == pytest.approx(z_up @ [0, -1, 0, 1])
    assert np.linalg.det(y_up[:3, :3]) == pytest.approx(8)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_json_and_yaml_say_the_same_and_assets_become_absolute(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    for name in ("a.ply", "room.obj", "sky.hdr", "skin.npz"):
        (tmp_path / "assets" / name).touch()
    document = {
        "name": "room",
        "real": {"geometry": {"model": "assets/room.obj"}},
        "objects": [
            {"asset": "assets/a.ply", "material": {"precomputed": "assets/skin.npz"}},
            {"asset": "sha256:00"},
        ],
        "lights": {"mode": "environment", "environment": {"map": "assets/sky.hdr"}},
    }
    scene = load_scene(write(tmp_path / "scene.json", json.dumps(document)))
    yaml_text = (
        "name: room\nreal: {geometry: {model: assets/room.obj}}\n"
        "objects:\n- {asset: assets/a.ply, material: {precomputed: assets/skin.npz}}\n- asset: 'sha256:00'\n"
        "lights: {mode: environment, environment: {map: assets/sky.hdr}}\n"
    )
    assert load_scene(write(tmp_path / "scene.yaml", yaml_text)) == scene
    folder = tmp_path.resolve() / "assets"
    assert [item.asset for item in scene.objects] == [str(folder / "a.ply"), "sha256:00"]
    assert scene.objects[0].material == PrecomputedMaterial(precomputed=str(folder / "skin.npz"))
    assert isinstance(scene.real.geometry, ModelGeometry)
    assert scene.real.geometry.model == str(folder / "room.obj")
    assert scene.lights.environment.map == str(folder / "sky.hdr")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.json", '{"objects": [{"asset": "gone.ply"}]}', r"`objects\[0\]\.asset` names .*gone\.ply"),
        ("s.json", '{"objects": [', "not valid JSON"),
        ("s.json", "[]", "keys and values"),
        ("s.json", "", r"s\.json is empty; write JSON"),
        ("s.yaml", "\n", r"s\.yaml is empty; write YAML"),
        ("s.yaml", "objects: [", "not valid YAML"),
        ("s.json", '{"a": ' * 100_000, r"s\.json is nested too deeply"),
        (
            "s.json",
            '{"revision": ' + "9" * 5000 + "}",
            "has a number of more than 4300 digits; give a shorter",
        ),
        ("s.json", r'{"name": "a\u0000b"}', "`name` is wrong: must not hold a NUL character"),
        (
            "s.json",
            r'{"objects": [{"id": "\u0000", "asset": "a"}]}',
            r"`objects\[0\]\.id` is wrong: must not hold",
        ),
        (
            "s.json",
            r'{"objects": [{"asset": "a.glb", "animation": {"clip": "\u0000"}}]}',
            r"`objects\[0\]\.animation\.clip` is wrong: must not hold a NUL character",
        ),
        (
            "s.json",
            '{"objects": [{"asset": "a.glb", "animation": {"clip": ""}}]}',
            r"`objects\[0\]\.animation\.clip` is wrong: must be the name of a clip, or its number \(from 0\)",
        ),
        (
            "s.json",
            r'{"real": {"surfaces": [{"region": {"material": "\u0000"}}]}}',
            r"`real\.surfaces\[0\]\.region\.material` is wrong: must not hold a NUL character",
        ),
        ("s.json", '{"lights": {"manual": [{"intensity": NaN}]}}', "finite"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(DeltalightError, match=message) as caught:
        load_scene(write(tmp_path / name, text))
    assert "\n" not in str(caught.value)


def test_a_key_that_comes_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text('{"output": {"width": 80, "height": 60, "width": 96}}')
    with pytest.raises(DeltalightError, match=r"scene\.json: `width` appears twice; remove one of them"):
        load_scene(path)


def test_a_missing_document_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match=r"none\.json cannot be read"):
        load_scene(tmp_path / "none.json")


def test_schema_forbids_unknown_keys_and_tells_units() -> None:
    schema = scene_json_schema()
    assert schema["additionalProperties"] is False
    definitions = schema["$defs"]
    assert all(
        part.get("additionalProperties") is False for part in definitions.values() if "properties" in part
    )
    assert definitions["SceneObject"]["required"] == ["asset"]
    assert "metres" in definitions["Pose"]["properties"]["translation_m"]["description"]
    assert definitions["DvctMethod"]["properties"]["cone_count"]["maximum"] == 64
    assert json.loads(json.dumps(schema)) == schema


def test_documents_are_values() -> None:
    assert SceneDocument() == parse_scene({})
    with pytest.raises(ValueError, match="frozen"):
        SceneDocument().name = "other"


def ply_vertices(path: Path) -> np.ndarray:
    """Vertices of a PLY file whose vertices begin with x y z as floats."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode()
    count = int(header.split("element vertex ")[1].split()[0])
    fields = header.split("element vertex")[1].split("element face")[0].count("property")
    if "ascii" in header:
        rows = data[end:].decode().splitlines()[:count]
        return np.array([row.split()[:3] for row in rows], float)
    order = "<" if "little" in header else ">"
    return np.frombuffer(data, f"{order}f4", count * fields, end).reshape(count, fields)[:, :3].astype(float)


@pytest.mark.data
def test_the_bunny_stands_on_the_real_table(shared_data: Path) -> None:
    scene = load_scene(shared_data / "rgbd" / "visp_rbt_apriltag" / "scene_bunny.json")
    bunny = scene.objects[0]
    vertices = ply_vertices(Path(bunny.asset))
    world = vertices @ bunny.world_from_object()[:3, :3].T + bunny.world_from_object()[:3, 3]
    up = np.array([-0.009, -1.0, 0.028])
    heights = (world - [0.5312, 0.0899, 0.5998]) @ (up / np.linalg.norm(up))
    assert abs(heights.min()) < 0.005
    assert 0.1 < heights.max() < 0.25


@pytest.mark.parametrize(
    "place", [("objects",), ("lights", "manual"), ("lights", "tracked"), ("real", "surfaces")]
)
def test_of_a_list_of_faults_only_the_first_is_made(place: tuple[str, ...]) -> None:
    """A body of 2 MB has a million, which take ten seconds and all threads wait for."""
    document: Any = [1] * 1000
    for key in reversed(place):
        document = {key: document}
    with pytest.raises(DeltalightError, match=rf"{re.escape('.'.join(place))}\[0\]") as fault:
        parse_scene(document)
    assert isinstance(fault.value.__cause__, ValidationError)
    assert fault.value.__cause__.error_count() == 1


@pytest.mark.parametrize("name", ["a" * 3000 + ".glb", "a\0b.glb"])
def test_names_that_no_file_has_are_sentences(tmp_path: Path, name: str) -> None:
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"objects": [{"asset": name}]}))
    with pytest.raises(DeltalightError, match="correct the path"):
        load_scene(path)
