"""What glTF clips, skins and morph targets do to meshes, against closed forms."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.protocol.scene_objects import Animation
from deltalight.render_server.scene.gltf_meshes import load_gltf
from deltalight.render_server.scene.mesh_loading import load_asset, load_mesh
from tests.render_server.gltf_samples import (
    HALF,
    IDENTITY,
    QUARTER_TURN,
    bar,
    bent_bar,
    box,
    edited,
    face_normals,
    morphing_box,
    moved_box,
    posed,
    primitive,
)


def rotation(path: Path, time_s: float) -> np.ndarray:
    """How the clip's box stands, from its corners."""
    return np.asarray(posed(path, time_s).positions.T.astype(float) @ np.linalg.pinv(box().vertices.T))


# Skins


@pytest.mark.parametrize("byte_weights", [False, True])
def test_a_bar_bent_by_90_degrees_is_where_two_bones_put_it(tmp_path: Path, byte_weights: bool) -> None:
    rest = bar()
    mesh = posed(bent_bar(tmp_path, byte_weights=byte_weights), 1.0)
    x, y, z = rest.vertices.T
    turned = np.stack([1 - y, 1 + x, z], axis=1)  # about (0, 1, 0): (x, 1 + h) goes to (-h, 1 + x)
    expected = np.where((y > 1)[:, None], turned, rest.vertices)
    half = y == 1
    expected[half] = (0.5 * (turned + rest.vertices))[half]
    tolerance = 3e-3 if byte_weights else 1e-6  # one half is 128 of 255 there
    np.testing.assert_allclose(mesh.positions, expected, atol=tolerance)
    nx, ny, nz = rest.vertex_normals.T
    normals = np.where((y > 1)[:, None], np.stack([-ny, nx, nz], axis=1), rest.vertex_normals)
    np.testing.assert_allclose(mesh.normals[~half], normals[~half], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


def test_a_bar_at_rest_is_the_mesh_itself_and_its_node_does_not_count(tmp_path: Path) -> None:
    (mesh,) = load_mesh(bent_bar(tmp_path))
    np.testing.assert_allclose(mesh.positions, bar().vertices, atol=1e-7)
    np.testing.assert_allclose(mesh.normals, bar().vertex_normals, atol=1e-7)


def test_normals_of_stretched_joints_stay_across_their_surface(tmp_path: Path) -> None:
    """Scaled by (1, 2, 1), a slope's normal turns the other way than the slope (inverse transpose)."""
    cone = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 1)], [(0, 1, 2)], process=False)
    normal = np.array([0, -HALF, HALF])
    glb = GlbBuilder()
    part = primitive(glb, cone, normals=False)
    part["attributes"]["NORMAL"] = glb.floats(np.tile(normal, (3, 1)))
    part["attributes"]["JOINTS_0"] = glb.array(np.zeros((3, 4), np.uint8))
    part["attributes"]["WEIGHTS_0"] = glb.floats(np.tile([1.0, 0, 0, 0], (3, 1)))
    joint = glb.add("nodes", {"scale": [1, 2, 1]})
    skin = glb.add("skins", {"joints": [joint]})
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]}), "skin": skin})
    (mesh,) = load_mesh(glb.write(tmp_path / "slope.glb"))
    np.testing.assert_allclose(mesh.normals[0], face_normals(mesh)[0], atol=1e-6)
    np.testing.assert_allclose(mesh.normals[0], np.array([0, -1, 2]) / np.sqrt(5), atol=1e-6)


def test_second_set_of_joints_counts_and_weights_are_brought_to_one(tmp_path: Path) -> None:
    mesh = box()
    glb = GlbBuilder()
    part = primitive(glb, mesh)
    for name, joint, weight in (("0", 0, 0.5), ("1", 1, 1.5)):
        part["attributes"][f"JOINTS_{name}"] = glb.array(np.full((8, 4), joint, np.uint16))
        part["attributes"][f"WEIGHTS_{name}"] = glb.floats(np.tile([weight, 0, 0, 0], (8, 1)))
    joints = [glb.add("nodes", {}), glb.add("nodes", {"translation": [4, 0, 0]})]
    skin = glb.add("skins", {"joints": joints})
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]}), "skin": skin})
    (found,) = load_mesh(glb.write(tmp_path / "two.glb"))
    np.testing.assert_allclose(found.positions - mesh.vertices, np.tile([3, 0, 0], (8, 1)), atol=1e-6)


# Morph targets


def test_morph_targets_add_up_by_their_weights(tmp_path: Path) -> None:
    deltas = [np.tile([1.0, 0, 0], (8, 1)), np.arange(24.0).reshape(8, 3)]
    path = morphing_box(tmp_path, deltas, normals=[np.zeros((8, 3))] * 2)
    found = posed(path, 0.25)
    np.testing.assert_allclose(found.positions, box().vertices + 0.25 * (deltas[0] + deltas[1]), atol=1e-6)


def test_given_normals_are_morphed_and_brought_to_length_one(tmp_path: Path) -> None:
    delta = np.tile([0.0, 0, 3], (8, 1))
    path = morphing_box(tmp_path, [np.zeros((8, 3))], normals=[delta])
    expected = box().vertex_normals + 0.5 * delta
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(posed(path, 0.5).normals, expected, atol=1e-6)


def test_a_flat_shaded_box_stays_flat_shaded_while_it_is_sheared(tmp_path: Path) -> None:
    shear = box().vertices[:, 2:] * [[2.0, 0, 0]]
    mesh = posed(morphing_box(tmp_path, [shear]), 1.0)
    assert len(mesh.positions) == 24, "corners are split where normals are"
    for corner in range(3):
        np.testing.assert_allclose(mesh.normals[mesh.triangles[:, corner]], face_normals(mesh), atol=1e-6)
    slopes = np.unique(np.abs(mesh.normals[:, 2]).round(4))
    np.testing.assert_allclose(slopes, [0, 2 / np.sqrt(5), 1], atol=1e-4)


def test_rest_weights_of_node_come_before_those_of_its_mesh(tmp_path: Path) -> None:
    path = morphing_box(tmp_path, [np.tile([0.0, 1, 0], (8, 1))])

    def set_weights(document: dict[str, Any]) -> None:
        document["meshes"][0]["weights"] = [0.5]

    (by_mesh,) = load_mesh(edited(path, set_weights))
    assert by_mesh.bounds()[0, 1] == pytest.approx(0.0)
    (by_node,) = load_mesh(edited(path, lambda document: document["nodes"][0].update(weights=[0.25])))
    assert by_node.bounds()[0, 1] == pytest.approx(-0.25)


# Sampling


@pytest.mark.parametrize("time_s", [0.0, 0.3, 0.7, 1.0, 1.6, 2.5, 3.0])
def test_cubic_keys_are_hermite_splines(tmp_path: Path, time_s: float) -> None:
    times = (0.0, 1.0, 2.5)
    random = np.random.default_rng(4)
    values, left, right = (random.normal(size=(3, 3)) for _ in range(3))
    keys = np.stack([left, values, right], axis=1).reshape(-1, 3)
    path = moved_box(tmp_path, "translation", keys, times, "CUBICSPLINE")
    at = min(time_s, 2.5)
    piece = 0 if at < 1 else 1
    spline = CubicHermiteSpline(
        times[piece : piece + 2], values[piece : piece + 2], [right[piece], left[piece + 1]]
    )
    np.testing.assert_allclose(posed(path, time_s).positions.mean(axis=0), spline(at), atol=1e-5)


def test_cubic_rotations_have_length_one(tmp_path: Path) -> None:
    zero = (0, 0, 0, 0)
    path = moved_box(
        tmp_path, "rotation", [zero, IDENTITY, zero, zero, QUARTER_TURN, zero], (0, 1), "CUBICSPLINE"
    )
    found = rotation(path, 0.5)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(found, Rotation.from_euler("z", 45, degrees=True).as_matrix(), atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.9])
def test_linear_rotations_follow_the_shorter_arc_at_even_speed(tmp_path: Path, share: float) -> None:
    random = np.random.default_rng(2)
    first, second = (turn / np.linalg.norm(turn) for turn in random.normal(size=(2, 4)))
    second = second * np.sign(first @ second)
    path = moved_box(tmp_path, "rotation", [first, -second])  # the same turn, the long way by its numbers
    expected = Slerp([0, 1], Rotation.from_quat([first, second]))(share).as_matrix()
    np.testing.assert_allclose(rotation(path, share), expected, atol=1e-5)


def test_almost_equal_rotations_are_mixed_without_noise(tmp_path: Path) -> None:
    tiny = Rotation.from_euler("x", 1e-6).as_quat()
    found = rotation(moved_box(tmp_path, "rotation", [IDENTITY, tiny]), 0.5)
    np.testing.assert_allclose(found, np.eye(3), atol=1e-6)


def test_steps_hold_and_ends_are_held(tmp_path: Path) -> None:
    path = moved_box(tmp_path, "translation", [[1, 0, 0], [2, 0, 0], [3, 0, 0]], (1.0, 2.0, 3.0), "STEP")
    asset = load_gltf(path)
    clip = asset.clip("move")
    assert clip is not None
    assert clip.duration_s == 3
    places = {t: posed(path, t).positions.mean(axis=0)[0] for t in (0.0, 1.0, 1.999, 2.0, 2.9, 3.0)}
    assert places == pytest.approx({0.0: 1, 1.0: 1, 1.999: 1, 2.0: 2, 2.9: 2, 3.0: 3})


def test_children_go_with_their_parents(tmp_path: Path) -> None:
    """Parent turned by 90 degrees about z, twice as large, 10 along x: (1, 0, 0) of the child lies at (10, 2, 0)."""
    parent = {"translation": [10, 0, 0], "rotation": QUARTER_TURN, "scale": [2, 2, 2]}
    path = moved_box(tmp_path, "translation", [[0, 0, 0], [2, 0, 0]], parent=parent)
    np.testing.assert_allclose(posed(path, 0.5).positions.mean(axis=0), [10, 2, 0], atol=1e-5)
    np.testing.assert_allclose(np.ptp(posed(path, 0.5).positions, axis=0), [2, 2, 2], atol=1e-5)


@pytest.mark.parametrize("normals", [True, False])
def test_a_mirroring_scale_does_not_turn_the_box_inside_out(tmp_path: Path, normals: bool) -> None:
    path = moved_box(tmp_path, "scale", [[1, 1, 1], [-1, 1, 1]], normals=normals)
    mesh = posed(path, 1.0)
    assert (face_normals(mesh) * mesh.positions[mesh.triangles].mean(axis=1)).sum(axis=1).min() > 0.1
    assert (mesh.normals * mesh.positions).sum(axis=1).min() > 0.1


def test_what_a_clip_shrinks_to_nothing_keeps_finite_normals(tmp_path: Path) -> None:
    mesh = posed(moved_box(tmp_path, "scale", [[1, 1, 1], [0, 0, 0]]), 1.0)
    assert np.ptp(mesh.positions) == 0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


# The clip's time and bounds


@pytest.mark.parametrize(
    ("animation", "expected"),
    [
        (Animation(), 1.5),
        (Animation(speed=2), 1.0),
        (Animation(speed=-1), 0.5),
        (Animation(offset_s=1.0), 0.5),
        (Animation(speed=0, offset_s=0.75), 0.75),
        (Animation(loop=False), 2.0),
        (Animation(loop=False, offset_s=-2.5), 1.0),
        (Animation(loop=False, offset_s=-10), 0.0),
    ],
)
def test_clip_time_follows_from_capture_time_alone(animation: Animation, expected: float) -> None:
    assert animation.time_s(3_500_000_000, 2.0) == pytest.approx(expected)


def test_capture_times_of_today_keep_their_milliseconds() -> None:
    one, other = (Animation().time_s(1_795_000_000_000_000_000 + step, 3.0) for step in (0, 1_000_000))
    assert other - one == pytest.approx(1e-3, abs=1e-6)


@pytest.mark.parametrize(
    "make", [bent_bar, lambda folder: moved_box(folder, "rotation", [IDENTITY, QUARTER_TURN])]
)
def test_bounds_hold_every_pose_and_little_more(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    asset = load_gltf(make(tmp_path))
    clip = asset.clip(0)
    assert clip is not None
    low, high = asset.bounds(clip)
    seen = np.concatenate([asset.meshes(asset.pose(clip, t))[0].positions for t in np.linspace(0, 1, 203)])
    assert (seen >= low).all()
    assert (seen <= high).all()
    longest = np.ptp(seen, axis=0).max()
    assert np.abs(seen.min(axis=0) - low).max() < 0.03 * longest
    assert np.abs(high - seen.max(axis=0)).max() < 0.03 * longest


def test_clips_are_found_by_name_and_number(tmp_path: Path) -> None:
    asset = load_gltf(bent_bar(tmp_path))
    assert [asset.clip(wanted) for wanted in (None, 0, "bend")] == [asset.clips[0]] * 3
    assert asset.clip("walk") is None
    assert asset.clip(1) is None
    assert load_asset(bent_bar(tmp_path)).animated is not None


def test_a_file_without_clips_has_nothing_to_play(tmp_path: Path) -> None:
    box().export(tmp_path / "still.glb")
    assert load_asset(tmp_path / "still.glb").animated is None
