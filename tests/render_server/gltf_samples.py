"""Small glTF files: a bar on two bones, a cube with morph targets, a box on a moving arm."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.render_server.scene.gltf_meshes import load_gltf
from deltalight.render_server.scene.triangle_mesh import TriangleMesh

HALF = np.sqrt(0.5)
QUARTER_TURN = (0.0, 0.0, HALF, HALF)  # about z, x y z w
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def primitive(glb: GlbBuilder, mesh: trimesh.Trimesh, *, normals: bool = True) -> dict[str, Any]:
    attributes = {"POSITION": glb.floats(mesh.vertices)}
    if normals:
        attributes["NORMAL"] = glb.floats(mesh.vertex_normals)
    return {"attributes": attributes, "indices": glb.array(mesh.faces.astype(np.uint32).ravel())}


def bar() -> trimesh.Trimesh:
    """Two units long along y, its rings at every quarter unit, no caps: each vertex's normal is radial."""
    ring, side = np.divmod(np.arange(9 * 4), 4)
    angle = side * np.pi / 2
    radial = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)
    vertices = 0.1 * radial + np.stack([0 * ring, ring / 4, 0 * ring], axis=1)
    a, b = np.arange(8 * 4), np.arange(8 * 4) // 4 * 4 + (np.arange(8 * 4) + 1) % 4
    faces = np.concatenate([np.stack([a, b, b + 4], 1), np.stack([a, b + 4, a + 4], 1)])
    return trimesh.Trimesh(vertices, faces, vertex_normals=radial, process=False)


def bent_bar(folder: Path, turn: Any = QUARTER_TURN, *, byte_weights: bool = False) -> Path:  # noqa: ANN401
    """The upper half hangs on a bone that turns about z within one second; the ring between has half of each bone.

    The mesh's own node stands elsewhere, which must not count.
    """
    glb, mesh = GlbBuilder(), bar()
    height = mesh.vertices[:, 1]
    upper = np.where(height > 1, 1.0, np.where(height == 1, 0.5, 0.0))
    joints = np.tile(np.array([0, 1, 0, 0], np.uint8), (len(upper), 1))
    weights = np.stack([1 - upper, upper, 0 * upper, 0 * upper], axis=1)
    part = primitive(glb, mesh)
    part["attributes"]["JOINTS_0"] = glb.array(joints)
    stored = np.round(255 * weights).astype(np.uint8) if byte_weights else weights.astype(np.float32)
    part["attributes"]["WEIGHTS_0"] = glb.array(stored, normalized=byte_weights)
    lower = glb.add("nodes", {"children": [1]})
    bone = glb.add("nodes", {"translation": [0, 1, 0]})
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 1, 3] = -1
    bind = glb.floats(inverse.transpose(0, 2, 1).reshape(2, 16))
    skin = glb.add("skins", {"joints": [lower, bone], "inverseBindMatrices": bind})
    node = {"mesh": glb.add("meshes", {"primitives": [part]}), "skin": skin, "translation": [5, 0, 0]}
    glb.add("scenes", {"nodes": [lower, glb.add("nodes", node)]})
    clip: dict[str, Any] = {"name": "bend"}
    glb.track(clip, bone, "rotation", glb.floats([0, 1]), [IDENTITY, turn])
    glb.add("animations", clip)
    return glb.write(folder / "bar.glb")


def box(edge: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.box((edge,) * 3)


def morphing_box(
    folder: Path, deltas: list[np.ndarray], *, normals: list[np.ndarray] | None = None, edge: float = 1.0
) -> Path:
    """A box whose targets add `deltas` to its eight corners; all weights go from 0 to 1 within a second."""
    glb, mesh = GlbBuilder(), box(edge)
    part = primitive(glb, mesh, normals=normals is not None)
    part["targets"] = [{"POSITION": glb.floats(delta)} for delta in deltas]
    for target, delta in zip(part["targets"], normals or [], strict=False):
        target["NORMAL"] = glb.floats(delta)
    node = glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]})})
    glb.add("scenes", {"nodes": [node]})
    clip: dict[str, Any] = {"name": "grow"}
    count = len(deltas)
    glb.track(clip, node, "weights", glb.floats([0, 1]), [0.0] * count + [1.0] * count)
    glb.add("animations", clip)
    return glb.write(folder / "box.glb")


def moved_box(
    folder: Path,
    path: str,
    keys: Any,  # noqa: ANN401
    times: tuple[float, ...] = (0.0, 1.0),
    interpolation: str = "LINEAR",
    *,
    edge: float = 1.0,
    parent: dict[str, Any] | None = None,
    normals: bool = True,
) -> Path:
    """A box at a node that a clip moves, below a node that stands as `parent` says."""
    glb = GlbBuilder()
    part = primitive(glb, box(edge), normals=normals)
    glb.add("nodes", {**(parent or {}), "children": [1]})
    node = glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]})})
    glb.add("scenes", {"nodes": [0]})
    clip: dict[str, Any] = {"name": "move"}
    glb.track(clip, node, path, glb.floats(times), keys, interpolation)
    glb.add("animations", clip)
    return glb.write(folder / "moved.glb")


def edited(path: Path, edit: Callable[[dict[str, Any]], None]) -> Path:
    """The file with its document changed."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    edit(document)
    glb = GlbBuilder()
    glb.document = {key: value for key, value in document.items() if key != "buffers"}
    glb._binary = data[28 + length :]
    return glb.write(path)


def posed(path: Path, time_s: float) -> TriangleMesh:
    asset = load_gltf(path)
    (mesh,) = asset.meshes(asset.pose(asset.clip(None), time_s))
    return mesh


def face_normals(mesh: TriangleMesh) -> np.ndarray:
    corners = mesh.positions[mesh.triangles].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
