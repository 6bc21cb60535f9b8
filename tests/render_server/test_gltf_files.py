"""How glTF files store what moves, and files that cannot be played."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.scene.gltf_meshes import GltfAsset, load_gltf
from deltalight.render_server.scene.mesh_loading import load_asset, load_mesh
from tests.render_server.gltf_samples import (
    bent_bar,
    box,
    edited,
    face_normals,
    morphing_box,
    moved_box,
    posed,
)


def test_quantised_and_sparse_arrays_are_decoded(tmp_path: Path) -> None:
    mesh, glb = box(), GlbBuilder()
    attributes = {
        "POSITION": glb.array(np.round(mesh.vertices * 2 * 32767).astype(np.int16), normalized=True),
        "NORMAL": glb.array(np.round(mesh.vertex_normals * 127).astype(np.int8), normalized=True),
    }
    # One corner is lifted by a sparse value.
    accessor = glb.document["accessors"][attributes["POSITION"]]
    lifted = np.array([[0, 0, 16384]], np.int16)
    accessor["sparse"] = {
        "count": 1,
        "indices": {"bufferView": glb.view(np.array([7], np.uint8)), "componentType": 5121},
        "values": {"bufferView": glb.view(lifted)},
    }
    part = {"attributes": attributes, "indices": glb.array(mesh.faces.astype(np.uint8).ravel())}
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]}), "scale": [0.5, 0.5, 0.5]})
    glb.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    (found,) = load_mesh(glb.write(tmp_path / "quantised.glb"))
    expected = np.array(mesh.vertices)
    expected[7] = [0, 0, 0.25]
    np.testing.assert_allclose(found.positions, expected, atol=1e-4)
    np.testing.assert_allclose(found.normals, mesh.vertex_normals, atol=1e-2)


def test_a_sparse_target_without_own_data_adds_to_few_vertices(tmp_path: Path) -> None:
    def make_sparse(document: dict[str, Any]) -> None:
        target = document["meshes"][0]["primitives"][0]["targets"][0]
        accessor = document["accessors"][target["POSITION"]]
        values = accessor.pop("bufferView")
        indices = document["meshes"][0]["primitives"][0]["indices"]
        view = document["accessors"][indices]["bufferView"]
        accessor["sparse"] = {
            "count": 1,  # of the first index of the faces
            "indices": {"bufferView": view, "componentType": 5125},
            "values": {"bufferView": values},
        }

    path = morphing_box(tmp_path, [np.tile([0.0, 0, 7], (8, 1))], normals=[np.zeros((8, 3))])
    moved = posed(edited(path, make_sparse), 1.0).positions - box().vertices
    assert np.flatnonzero(np.abs(moved).max(axis=1) > 1e-5).tolist() == [box().faces[0, 0]]
    assert moved.max() == pytest.approx(7)


def test_strips_and_fans_become_triangles(tmp_path: Path) -> None:
    quad = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    for mode, order in ((5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
        glb = GlbBuilder()
        attributes = {"POSITION": glb.floats(quad[order])}
        mesh = glb.add("meshes", {"primitives": [{"attributes": attributes, "mode": mode}]})
        glb.add("nodes", {"mesh": mesh})
        (found,) = load_mesh(glb.write(tmp_path / "flat.glb"))
        np.testing.assert_allclose(face_normals(found), [[0, 0, 1]] * 2, atol=1e-6)


def channel(document: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = document["animations"][0]["channels"][0]
    return found


def sampler(document: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = document["animations"][0]["samplers"][0]
    return found


def swap_times(document: dict[str, Any]) -> None:
    sampler(document)["input"], sampler(document)["output"] = (
        sampler(document)["output"],
        sampler(document)["input"],
    )


def circle(document: dict[str, Any]) -> None:
    document["nodes"] += [{"children": [len(document["nodes"]) + 1]}, {"children": [len(document["nodes"])]}]


def sparse_bomb(document: dict[str, Any]) -> None:
    document["accessors"].append({**document["accessors"][0], "count": 400_000_000})
    del document["accessors"][-1]["bufferView"]
    view = document["accessors"][0]["bufferView"]
    places = {"bufferView": view, "componentType": 5125}
    document["accessors"][-1]["sparse"] = {"count": 1, "indices": places, "values": {"bufferView": view}}


FAULTS: list[tuple[str, Callable[[dict[str, Any]], Any], str]] = [
    ("sampler", lambda d: channel(d).update(sampler=7), "animation `bend`, channel 0 names a sampler"),
    ("interpolation", lambda d: sampler(d).update(interpolation="MAGIC"), "interpolation 'MAGIC'"),
    ("node", lambda d: channel(d)["target"].update(node=99), "moves node 99, which does not exist"),
    ("weights", lambda d: channel(d)["target"].update(path="weights"), "no morph targets"),
    ("keys", lambda d: sampler(d).update(interpolation="CUBICSPLINE"), "8 numbers where 24 belong"),
    ("times", swap_times, "components where 1 belong"),
    ("matrix", lambda d: d["nodes"][1].update(matrix=np.eye(4).ravel().tolist()), "given as a matrix"),
    ("circle", circle, "form a circle"),
    ("joint", lambda d: d["skins"][0].update(joints=[0, 9]), "joints that do not exist"),
    ("few joints", lambda d: d["skins"][0].update(joints=[0]), "joint 1 of a skin of 1"),
    ("bind", lambda d: d["skins"][0].update(joints=[0, 1, 2]), "fewer inverse bind matrices"),
    ("rotation", lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]), "rotation of length 0"),
    ("nan", lambda d: d["nodes"][0].update(translation=[0, float("nan"), 0]), "translation is not finite"),
    ("sparse", sparse_bomb, "sparse accessors grow"),
    ("targets", lambda d: d["nodes"][2].update(weights=[1.0]), "0 morph targets has the weights"),
]


@pytest.mark.parametrize(
    ("edit", "sentence"), [fault[1:] for fault in FAULTS], ids=[fault[0] for fault in FAULTS]
)
def test_files_that_cannot_be_played_are_refused_in_a_sentence(
    tmp_path: Path, edit: Callable[[dict[str, Any]], Any], sentence: str
) -> None:
    path = edited(bent_bar(tmp_path), edit)
    with pytest.raises(DeltalightError, match=sentence) as caught:
        load_asset(path)
    assert "bar.glb" in str(caught.value)


def test_keys_and_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match="not finite"):
        load_asset(bent_bar(tmp_path, turn=(0, float("nan"), 0, 1)))


def test_a_clip_that_leaves_the_world_is_refused(tmp_path: Path) -> None:
    asset: GltfAsset = load_gltf(moved_box(tmp_path, "translation", [[0, 0, 0], [0, 0, 1e6]]))
    with pytest.raises(DeltalightError, match="beyond 10 km"):
        asset.bounds(asset.clips[0])
