import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import Material as MaterialDocument
from deltalight.render_server.scene.gpu_mesh import merge_for_gpu
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.render_server.scene.texture_maps import TextureMap
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.scene.triangle_splitting import split_triangles

CUBE_OBJ = """
mtllib cube.mtl
usemtl clay
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""


def write_sphere(path: Path, radius: float = 0.5) -> Path:
    trimesh.creation.icosphere(subdivisions=4, radius=radius).export(path)
    return path


def triangle(material: Material | None = None, uv: np.ndarray | None = None) -> TriangleMesh:
    return TriangleMesh(
        positions=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (3, 1)),
        triangles=np.array([[0, 1, 2]], np.int32),
        uv=uv,
        material=material or Material(),
    )


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".glb"])
def test_sphere_of_every_format_has_the_spheres_normals(tmp_path: Path, suffix: str) -> None:
    (mesh,) = load_mesh(write_sphere(tmp_path / f"sphere{suffix}"))
    radial = mesh.positions / np.linalg.norm(mesh.positions, axis=1, keepdims=True)
    assert (mesh.normals * radial).sum(axis=1).min() > 0.999
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(mesh.bounds(), [[-0.5] * 3, [0.5] * 3], atol=0.01)
    assert len(mesh.triangles) == 5120


def test_cube_keeps_its_edges_sharp_and_takes_over_its_library(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE_OBJ)
    (tmp_path / "cube.mtl").write_text("newmtl clay\nKd 0.25 0.5 0.75\nKe 1 2 3\nKs 0 0 0\nNs 6\n")
    (mesh,) = load_mesh(tmp_path / "cube.obj")
    assert len(mesh.triangles) == 12
    assert len(mesh.positions) == 24
    assert np.sort(np.abs(mesh.normals), axis=1) == pytest.approx(np.tile([0, 0, 1], (24, 1)), abs=1e-6)
    material = mesh.material
    assert material.base_color == pytest.approx([0.25, 0.5, 0.75])
    assert material.emission == pytest.approx([1, 2, 3])
    assert material.f0 == pytest.approx([0, 0, 0])
    assert material.roughness == pytest.approx(0.25**0.25)
    assert material.name == "clay"


def test_a_plate_on_a_plate_meets_at_the_given_crease(tmp_path: Path) -> None:
    angle = np.radians(30)
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    points += [(0, -np.cos(angle), np.sin(angle)), (1, -np.cos(angle), np.sin(angle))]
    text = "\n".join(f"v {x} {y} {z}" for x, y, z in points) + "\nf 1 2 3\nf 1 3 4\nf 5 6 2\nf 5 2 1\n"
    (tmp_path / "bent.obj").write_text(text)
    (mesh,) = load_mesh(tmp_path / "bent.obj")
    assert len(mesh.positions) == 6
    shared = np.linalg.norm(mesh.positions[:, 1:], axis=1) < 1e-6
    half = angle / 2
    expected = np.tile([0, np.sin(half), np.cos(half)], (2, 1))
    assert mesh.normals[shared] == pytest.approx(expected, abs=0.1)


def gltf_scene(tmp_path: Path) -> Path:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[:2] = 255
    material = trimesh.visual.material.PBRMaterial(
        name="painted", metallicFactor=0.25, roughnessFactor=0.75, baseColorTexture=Image.fromarray(pixels)
    )
    uv = sphere.vertices[:, :2] * 0.5 + 0.5
    sphere.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    scene = trimesh.Scene()
    for x in (0.0, 3.0):
        matrix = np.diag([-1.0, 1, 1, 1])
        matrix[0, 3] = x
        scene.add_geometry(sphere, transform=matrix)
    path = tmp_path / "two.glb"
    path.write_bytes(scene.export(file_type="glb"))
    return path


Edit = Callable[[dict[str, Any]], None]


def edit_glb(path: Path, edit: Edit) -> None:
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    edit(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(header + text + rest)


def test_gltf_nodes_are_placed_and_mirrored_without_turning_inside_out(tmp_path: Path) -> None:
    path = gltf_scene(tmp_path)

    def add_extensions(document: dict[str, Any]) -> None:
        document["materials"][0]["emissiveFactor"] = [0.5, 0.25, 1.0]
        document["materials"][0]["extensions"] = {
            "KHR_materials_ior": {"ior": 2.0},
            "KHR_materials_emissive_strength": {"emissiveStrength": 8.0},
            "KHR_materials_transmission": {"transmissionFactor": 0.5},
        }

    edit_glb(path, add_extensions)
    (mesh,) = load_mesh(path)
    np.testing.assert_allclose(mesh.bounds(), [[-1, -1, -1], [4, 1, 1]], atol=1e-5)
    corners = mesh.positions[mesh.triangles].astype(float)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((faces * mesh.normals[mesh.triangles[:, 0]]).sum(axis=1) > 0).all()
    centre = np.where(mesh.positions[:, :1] > 1.5, 3.0, 0.0) * [1, 0, 0]
    assert ((mesh.positions - centre) * mesh.normals).sum(axis=1).min() > 0.95
    material = mesh.material
    assert (material.metallic, material.roughness, material.name) == (0.25, 0.75, "painted")
    assert material.emission == pytest.approx([4, 2, 8])
    assert material.transmission == 0.5
    assert material.dielectric_f0 == pytest.approx(np.full(3, 1 / 9))
    assert material.f0 == pytest.approx(np.full(3, 0.75 / 9 + 0.25))


def test_texture_is_linear_and_its_top_row_is_v_zero(tmp_path: Path) -> None:
    (mesh,) = load_mesh(gltf_scene(tmp_path))
    texture = mesh.material.base_color_texture
    assert texture is not None
    assert mesh.uv is not None
    assert texture[0].min() == 1
    assert texture[-1].max() == 0
    # The exporter's uv has its origin at the bottom: the sphere's top (y = 1) is at v = 0 here.
    assert mesh.uv[:, 1] == pytest.approx(0.5 - mesh.positions[:, 1] / 2, abs=1e-5)


def test_vertex_colours_are_decoded(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    sphere.visual.vertex_colors = np.tile(np.array([188, 0, 255, 255], np.uint8), (len(sphere.vertices), 1))
    sphere.export(tmp_path / "colored.ply")
    (mesh,) = load_mesh(tmp_path / "colored.ply")
    assert mesh.colors is not None
    assert mesh.colors[0] == pytest.approx([0.503, 0, 1], abs=2e-3)
    assert mesh.material.base_color == pytest.approx([1, 1, 1])


def test_degenerate_triangles_are_dropped(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 1 3\n"
    (tmp_path / "some.obj").write_text(text)
    (mesh,) = load_mesh(tmp_path / "some.obj")
    assert len(mesh.triangles) == 1
    assert mesh.normals[mesh.triangles[0]] == pytest.approx(np.tile([0, 0, 1], (3, 1)))


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("mesh.xyz", "", "not a mesh file"),
        ("empty.obj", "v 0 0 0\n", "no triangle"),
        ("line.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangle"),
        ("far.obj", "v 0 0 0\nv 1 0 0\nv 0 20000 0\nf 1 2 3\n", "beyond 10 km"),
        ("nan.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not finite"),
        ("index.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "read as a mesh|do not exist"),
        ("normal.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 nan 1\nf 1//1 2//1 3//1\n", "normals"),
        ("broken.glb", "glTF but not really", "glTF 2 file"),
        ("broken.gltf", "{", "glTF 2 file"),
        ("broken.stl", "solid nothing", "cannot be read|no triangle"),
        (
            "liar.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n",
            "more elements",
        ),
    ],
)
def test_bad_files_are_refused_in_a_sentence(tmp_path: Path, name: str, text: str, sentence: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(DeltalightError, match=sentence):
        load_mesh(tmp_path / name)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match=r"away\.obj does not exist"):
        load_mesh(tmp_path / "away.obj")


def huge_accessor(document: dict[str, Any]) -> None:
    document["accessors"][0]["count"] = 400_000_000


def huge_without_data(document: dict[str, Any]) -> None:
    document["accessors"].append({"componentType": 5126, "type": "VEC4", "count": 100_000_000})


def negative_offset(document: dict[str, Any]) -> None:
    document["bufferViews"][0]["byteOffset"] = -8


def cyclic_nodes(document: dict[str, Any]) -> None:
    document["nodes"][0].setdefault("children", []).append(len(document["nodes"]) - 1)
    document["nodes"][-1].setdefault("children", []).append(len(document["nodes"]) - 1)


def instance_bomb(document: dict[str, Any]) -> None:
    document["nodes"] += [{"mesh": 0}] * 100_000


def escaping_image(document: dict[str, Any]) -> None:
    document["images"] = [{"uri": "../../../etc/passwd"}]


def required_extension(document: dict[str, Any]) -> None:
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]


@pytest.mark.parametrize(
    "edit",
    [
        huge_accessor,
        huge_without_data,
        negative_offset,
        cyclic_nodes,
        instance_bomb,
        escaping_image,
        required_extension,
    ],
)
def test_gltf_that_lies_about_itself_is_refused(tmp_path: Path, edit: Edit) -> None:
    path = gltf_scene(tmp_path)
    load_mesh(path)
    edit_glb(path, edit)
    with pytest.raises(DeltalightError):
        load_mesh(path)


def test_buffer_outside_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "outside.bin").write_bytes(bytes(36))
    inner = tmp_path / "inner"
    inner.mkdir()
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36, "uri": "../outside.bin"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
    }
    (inner / "mesh.gltf").write_text(json.dumps(document))
    with pytest.raises(DeltalightError, match="outside its own folder"):
        load_mesh(inner / "mesh.gltf")


def test_material_of_the_document_replaces_all() -> None:
    document = MaterialDocument(base_color=(0.1, 0.2, 0.3), metallic=1.0, roughness=0.2, emission=(5, 6, 7))
    material = Material.from_document(document)
    assert material.f0 == pytest.approx([0.1, 0.2, 0.3])
    assert material.emission == pytest.approx([5, 6, 7])


def test_merging_keeps_every_triangle_and_its_material() -> None:
    texture = np.ones((2, 2, 3), np.float16)
    textured = Material(
        base_color=np.array([1, 0, 0], np.float32), base_color_map=TextureMap(texture), double_sided=True
    )
    merged = merge_for_gpu([triangle(), triangle(material=textured, uv=np.full((3, 2), 0.25, np.float32))])
    assert merged.vertices.shape == (6, 12)
    assert merged.triangles.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert merged.vertices[:, 11].tolist() == [0, 0, 0, 1, 1, 1]
    assert merged.vertices[3:, 6:8].min() == 0.25
    assert merged.vertices[:, 8:11].min() == 1
    assert merged.material_table[1, :3].tolist() == [1, 0, 0]
    assert merged.material_table[:, 12].tolist() == [0, 1]
    assert merged.placement is None


def area(corners: np.ndarray) -> float:
    edges = corners[:, 1:, :3].astype(float) - corners[:, :1, :3]
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2)


def test_splitting_bounds_edges_and_keeps_area_winding_and_attributes() -> None:
    rng = np.random.default_rng(3)
    corners = rng.uniform(-1, 1, (50, 3, 5)).astype(np.float32)
    corners[..., 3] = 2 * corners[..., 0] - corners[..., 1]
    corners[..., 4] = np.arange(50)[:, None]
    pieces = split_triangles(corners, 0.2)
    edges = np.roll(pieces[..., :3], -1, axis=1) - pieces[..., :3]
    assert np.linalg.norm(edges, axis=2).max() <= 0.2
    assert area(pieces) == pytest.approx(area(corners), rel=1e-4)
    assert pieces[..., 3] == pytest.approx(2 * pieces[..., 0] - pieces[..., 1], abs=1e-5)
    assert (pieces[..., 4] == pieces[:, :1, 4]).all()
    wanted = np.cross(*np.moveaxis(corners[:, 1:, :3] - corners[:, :1, :3], 1, 0))
    got = np.cross(*np.moveaxis(pieces[:, 1:, :3] - pieces[:, :1, :3], 1, 0))
    assert ((wanted[pieces[:, 0, 4].astype(int)] * got).sum(axis=1) > 0).all()


def test_splitting_leaves_small_triangles_and_nothing_alone() -> None:
    corners = np.random.default_rng(0).uniform(0, 0.1, (4, 3, 3)).astype(np.float32)
    assert np.array_equal(split_triangles(corners, 1.0), corners)
    assert split_triangles(np.zeros((0, 3, 7), np.float32), 1.0).shape == (0, 3, 7)


def test_splitting_refuses_to_fill_the_memory() -> None:
    corners = np.array([[[0, 0, 0], [1e4, 0, 0], [0, 1e4, 0]]], np.float32)
    with pytest.raises(DeltalightError, match="splits into more"):
        split_triangles(corners, 0.01)


@pytest.mark.data
def test_meshes_of_the_papers_load(shared_data: Path) -> None:
    (buddha,) = load_mesh(shared_data / "paper_scene_dirtchamber/data/tracked/happy.obj")
    assert len(buddha.triangles) == 20_000
    assert buddha.material.base_color == pytest.approx([1, 0.2, 0.1])
    (dragon,) = load_mesh(shared_data / "meshes/dragon_100k.obj")
    assert len(dragon.triangles) == 100_000
    (head,) = load_mesh(shared_data / "meshes/LeePerrySmith/LeePerrySmith.glb")
    assert head.uv is not None
