"""What is precomputed for occlusion fields: harmonics, what an object hides, what it reflects, and the files."""

import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64

from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.lights.octahedral import even_directions, harmonics
from deltalight.render_server.precomputation.job_cache import Checkpoint
from deltalight.render_server.precomputation.occlusion_fields import (
    OcclusionFields,
    compute_field,
    field_digest,
    load_field,
    store_field,
)
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.occlusion_field import (
    FieldSettings,
    ObjectRays,
    OcclusionField,
    place_shells,
)
from deltalight.render_server.scene.occlusion_transfer import object_surface
from deltalight.render_server.scene.texture_maps import TextureMap, Wrap
from deltalight.render_server.scene.triangle_mesh import TriangleMesh

SETTINGS = FieldSettings(order=4, shells=3, resolution=12, reach=4.0, rays=256, indirect=True)
RADIUS = 0.5


def mesh_of(shape: trimesh.Trimesh, color: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> TriangleMesh:
    return TriangleMesh(
        np.asarray(shape.vertices, np.float32),
        np.asarray(shape.vertex_normals, np.float32),
        np.asarray(shape.faces, np.int32),
        None,
        Material(base_color=np.array(color, np.float32)),
    )


@pytest.mark.parametrize(
    ("uv_set", "shift", "wrap", "expected"),
    [
        (0, (0.0, 0.0), Wrap.REPEAT, [0.1, 0.2, 0.4]),
        (1, (0.0, 0.0), Wrap.REPEAT, [0.2, 0.1, 0.3]),
        (0, (0.5, 0.0), Wrap.REPEAT, [0.2, 0.1, 0.3]),
        (0, (0.5, 0.5), Wrap.CLAMP, [0.4, 0.4, 0.4]),
        (0, (1.0, 0.0), Wrap.MIRROR, [0.2, 0.1, 0.3]),
    ],
)
def test_reflectance_is_that_of_the_texture_where_it_lies(
    uv_set: int, shift: tuple[float, float], wrap: Wrap, expected: list[float]
) -> None:
    """On its set of coordinates, with its transform, beyond its edges as it says."""
    texels = np.repeat(np.array([[0.1, 0.2], [0.3, 0.4]], np.float16)[..., None], 3, axis=2)
    from_uv = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    texture = TextureMap(texels, uv_set, from_uv, (wrap, wrap))
    sets = np.array([[(0.2, 0.2), (0.7, 0.2), (0.7, 0.7)], [(0.7, 0.2), (0.2, 0.2), (0.2, 0.7)]], np.float32)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0)], np.float32)
    white = Material(base_color=np.ones(3, np.float32), base_color_map=texture)
    up = np.tile(np.array([0, 0, 1], np.float32), (3, 1))
    mesh = TriangleMesh(corners, up, np.array([[0, 1, 2]], np.int32), sets[0], white, second_uv=sets[1])
    (found,) = object_surface([mesh], plain=False)
    assert found[:, 3:] == pytest.approx(np.repeat(np.array(expected)[:, None], 3, axis=1), abs=1e-3)


@pytest.mark.parametrize(
    ("textured", "texel"),
    [
        (lambda data: {"metallic": 1.0, "metallic_roughness_map": data}, (0, 128, 51)),
        (lambda data: {"transmission": 1.0, "transmission_map": data}, (51, 0, 0)),
    ],
    ids=["metal", "clear"],
)
def test_a_texture_tells_which_part_is_metal_or_clear(
    textured: Callable[[TextureMap], dict[str, Any]], texel: tuple[int, int, int]
) -> None:
    """Whose factor may be 1 for all of it; what is metal, or lets light through, has no diffuse reflectance."""
    data = TextureMap(np.array([[(0, 128, 0), texel]], np.uint8))
    material = Material(base_color=np.full(3, 0.5, np.float32), **textured(data))
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0)], np.float32)
    up, uv = (
        np.tile(np.array([0, 0, 1], np.float32), (3, 1)),
        np.array([(0.2, 0), (0.7, 0), (0.7, 0)], np.float32),
    )
    mesh = TriangleMesh(corners, up, np.array([[0, 1, 2]], np.int32), uv, material)
    (found,) = object_surface([mesh], plain=False)
    assert found[:, 3] == pytest.approx([0.5, 0.4, 0.4])


def test_what_light_passes_through_reflects_the_rest() -> None:
    material = Material(base_color=np.full(3, 0.5, np.float32), metallic=0.2, transmission=0.75)
    mesh = replace(mesh_of(trimesh.creation.box()), material=material)
    assert object_surface([mesh], plain=False)[..., 3:] == pytest.approx(0.5 * 0.8 * 0.25)


@pytest.fixture(scope="module")
def ball() -> TriangleMesh:
    return mesh_of(trimesh.creation.icosphere(3, RADIUS))


@pytest.fixture(scope="module")
def ball_field(ball: TriangleMesh) -> OcclusionField:
    return compute_field(object_surface([ball], plain=True), SETTINGS, lambda _share: None)


def sample_points(found: OcclusionField, shell: int) -> Float64[np.ndarray, "n n n 3"]:
    n = found.occlusion.shape[1]
    return found.grid.points(shell, n).reshape(n, n, n, 3).astype(np.float64)


def test_harmonics_are_orthonormal_and_turn_a_cosine_into_itself() -> None:
    directions = even_directions(20000)
    basis = harmonics(directions, 5)
    assert basis.T @ basis * 4 * np.pi / 20000 == pytest.approx(np.eye(25), abs=1e-4)
    normal = np.array([[0.6, 0.0, 0.8]])
    # What a clamped cosine leaves of each band (Ramamoorthi & Hanrahan 2001, eq. 8).
    bands = [np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24]
    transfer = harmonics(normal, 5)[0] * np.repeat(bands, [1, 3, 5, 7, 9])
    cosine = np.maximum(directions @ normal[0], 0)
    assert transfer == pytest.approx(cosine @ basis * 4 * np.pi / 20000, abs=1e-3)


def test_shells_lie_in_each_other_and_the_object_in_the_first(ball: TriangleMesh) -> None:
    rays = ObjectRays(ball.positions[ball.triangles])
    grid = place_shells(rays, SETTINGS)
    assert (np.diff(grid.halves, axis=0) > 0).all()
    assert grid.halves[-1] == pytest.approx(SETTINGS.reach * rays.radius)
    assert (rays.half < grid.halves[0]).all()


def test_what_a_ball_hides_is_its_cone(ball_field: OcclusionField) -> None:
    """Coefficients of a cap of half-angle asin(R/d) about the way to the centre; solid angle and all."""
    directions = even_directions(100_000)
    basis = harmonics(directions, 4) * 4 * np.pi / len(directions)
    for shell in range(SETTINGS.shells):
        points = sample_points(ball_field, shell).reshape(-1, 3)
        away = np.linalg.norm(points, axis=1)
        for number in np.flatnonzero(away > 1.05 * RADIUS)[:: 97 * 3]:
            cap = directions @ (-points[number] / away[number]) > math.sqrt(1 - (RADIUS / away[number]) ** 2)
            got = ball_field.occlusion[shell].reshape(-1, 16)[number]
            solid_angle = 2 * np.pi * (1 - math.sqrt(1 - (RADIUS / away[number]) ** 2))
            assert got == pytest.approx(cap @ basis, abs=0.02 + 0.02 * solid_angle)


def test_coefficients_are_those_of_brute_force_rays() -> None:
    """A box with a hole, seen from beside it: trimesh's own intersections say the same."""
    shape = trimesh.util.concatenate(
        [trimesh.creation.box((0.2, 1.0, 1.0)), trimesh.creation.icosphere(2, 0.3)]
    )
    corners = np.asarray(shape.triangles, np.float32)
    rays = ObjectRays(corners)
    point = np.array([[0.7, 0.1, 0.3]], np.float32)
    for _, chosen, hits in rays.trace(point, 256):
        met = np.zeros(len(chosen.directions), bool)
        met[hits.direction] = True
    start = np.repeat(point, len(met), axis=0)
    expected = brute_force(shape.triangles, start.astype(float), chosen.directions.astype(float))
    assert (met == expected).mean() > 0.995
    assert 0.1 < met.mean() < 0.6


def brute_force(
    triangles: Float64[np.ndarray, "m 3 3"],
    start: Float64[np.ndarray, "r 3"],
    way: Float64[np.ndarray, "r 3"],
) -> np.ndarray:
    """Which rays meet any triangle: every pair is tried (Moeller and Trumbore 1997)."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    met = np.zeros(len(way), bool)
    for corner, one, other in zip(triangles[:, 0], first, second, strict=True):
        p = np.cross(way, other)
        det = p @ one
        det = np.where(np.abs(det) < 1e-12, np.inf, det)
        s = start - corner
        u = np.einsum("rk,rk->r", s, p) / det
        q = np.cross(s, one)
        v = np.einsum("rk,rk->r", way, q) / det
        met |= (u >= 0) & (v >= 0) & (u + v <= 1) & (q @ other / det > 0)
    return met


def test_samples_within_the_object_are_those_of_the_nearest_outside(ball_field: OcclusionField) -> None:
    points = sample_points(ball_field, 0)
    away = np.linalg.norm(points, axis=-1)
    share = ball_field.occlusion[0][..., 0].astype(float) * math.sqrt(4 * np.pi) / (4 * np.pi)
    assert (away < 0.5 * RADIUS).any()
    assert share[away < 0.5 * RADIUS].max() < 0.55
    assert share[(away > RADIUS) & (away < 1.3 * RADIUS)].min() > 0.15


def test_a_white_ball_in_even_light_sends_back_what_it_hides(ball_field: OcclusionField) -> None:
    """Radiance 1 from everywhere: a convex object of reflectance 1 shines like what lies behind it."""
    assert ball_field.transfer is not None
    light = np.zeros(9)
    light[0] = math.sqrt(4 * np.pi)
    sent = np.einsum("...klc,l->...kc", ball_field.transfer.astype(float), light)
    n = ball_field.transfer.shape[1]
    for shell in range(SETTINGS.shells):
        points = ball_field.grid.points(shell, n)
        away = np.linalg.norm(points, axis=1)
        outside = away > 1.05 * RADIUS
        ratio = np.minimum(RADIUS / away[outside], 1.0)
        solid_angle = 2 * np.pi * (1 - np.sqrt(1 - ratio**2))
        got = sent[shell].reshape(-1, 9, 3)[outside, 0] * math.sqrt(4 * np.pi)
        assert got == pytest.approx(np.repeat(solid_angle[:, None], 3, axis=1), rel=0.08, abs=0.03)


def test_the_assets_own_colours_are_kept_and_a_given_material_takes_their_place(ball: TriangleMesh) -> None:
    red = mesh_of(trimesh.creation.icosphere(1, RADIUS), (0.8, 0.2, 0.0))
    assert object_surface([red], plain=False)[..., 3:].reshape(-1, 3)[0] == pytest.approx((0.8, 0.2, 0.0))
    assert (object_surface([red], plain=True)[..., 3:] == 1).all()
    digests = {field_digest(object_surface([red], plain=plain), SETTINGS) for plain in (False, True)}
    digests.add(field_digest(object_surface([ball], plain=True), SETTINGS))
    assert len(digests) == 3


def test_a_field_is_read_as_it_was_written_and_damage_is_noticed(
    tmp_path: Path, ball_field: OcclusionField
) -> None:
    store_field(tmp_path / "new", "ab", ball_field)
    path = tmp_path / "new" / "ab.npz"
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["ab.npz", "ab.npz.sha256"]
    again = load_field(path.parent, "ab", SETTINGS)
    assert again is not None
    assert (again.occlusion == ball_field.occlusion).all()
    assert again.radius == ball_field.radius
    assert load_field(path.parent, "none", SETTINGS) is None
    whole = path.read_bytes()
    for damaged in (
        whole[: len(whole) // 2],
        b"",
        b"PK\x03\x04nonsense",
        whole[:3000] + b"\xff" * 4000 + whole[7000:],
    ):
        path.write_bytes(damaged)
        assert load_field(path.parent, "ab", SETTINGS) is None


def placed(mesh: TriangleMesh) -> PlacedObject:
    return PlacedObject("ball", (mesh,), np.eye(4), Material())


def test_fields_are_computed_once_and_again_where_the_file_is_damaged(
    tmp_path: Path, ball: TriangleMesh
) -> None:
    said: list[str] = []
    first = OcclusionFields(said.append, tmp_path).find(placed(ball), SETTINGS)
    assert first is not None
    (file,) = tmp_path.glob("*.npz")
    second = OcclusionFields(said.append, tmp_path).find(placed(ball), SETTINGS)
    assert second is not None
    assert (second.occlusion == first.occlusion).all()
    file.write_bytes(b"damaged")
    third = OcclusionFields(said.append, tmp_path).find(placed(ball), SETTINGS)
    assert third is not None
    assert (third.occlusion == first.occlusion).all()
    assert file.stat().st_size > 1000
    assert said == []


def test_fields_that_were_not_used_for_longest_give_way(
    tmp_path: Path, ball_field: OcclusionField, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(3):
        store_field(tmp_path, str(number), ball_field)
        os.utime(tmp_path / f"{number}.npz", ns=(number, number))
    assert load_field(tmp_path, "0", SETTINGS) is not None
    room = 3 * (tmp_path / "0.npz").stat().st_size
    monkeypatch.setattr("deltalight.render_server.precomputation.job_cache.cache_limit_bytes", lambda: room)
    store_field(tmp_path, "3", ball_field)
    assert sorted(path.name for path in tmp_path.glob("*.npz*")) == [
        f"{number}.npz{end}" for number in (0, 2, 3) for end in ("", ".sha256")
    ]


def test_a_second_start_computes_nothing(
    tmp_path: Path, ball: TriangleMesh, ball_field: OcclusionField, monkeypatch: pytest.MonkeyPatch
) -> None:
    store_field(tmp_path, field_digest(object_surface([ball], plain=True), SETTINGS), ball_field)
    monkeypatch.setattr(
        "deltalight.render_server.precomputation.occlusion_fields.compute_field",
        lambda *_: pytest.fail("computed"),
    )
    found = OcclusionFields(pytest.fail, tmp_path).find(placed(ball), SETTINGS)
    assert found is not None
    assert (found.occlusion == ball_field.occlusion).all()


def test_a_field_that_was_broken_off_goes_on_with_its_next_shell(
    tmp_path: Path, ball: TriangleMesh, ball_field: OcclusionField
) -> None:
    surface = object_surface([ball], plain=True)
    parts, computed = Checkpoint(tmp_path, "ab"), []

    def counting(name: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
        def counted() -> np.ndarray:
            computed.append(name)
            return compute()

        return parts.part(name, counted)

    def break_off(done: float) -> None:
        if done > 0.9:  # in the last but one shell of what the ball reflects
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compute_field(surface, SETTINGS, break_off, counting)
    damaged = tmp_path / "ab-occlusion-1.npz"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    computed.clear()
    again = compute_field(surface, SETTINGS, lambda _share: None, counting)
    assert computed == ["occlusion-1", "transfer-2"]
    assert (again.occlusion == ball_field.occlusion).all()
    assert again.transfer is not None
    assert ball_field.transfer is not None
    assert (again.transfer == ball_field.transfer).all()
    parts.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_terminal_shows_how_far_the_field_is(
    tmp_path: Path,
    ball: TriangleMesh,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    OcclusionFields(pytest.fail, tmp_path).find(placed(ball), SETTINGS)
    shown = capsys.readouterr()
    assert "occlusion field of `ball`" in shown.err
    assert "100%" in shown.err
    assert shown.out == ""


def test_beside_rendering_a_field_arrives_later_and_the_user_is_told(
    tmp_path: Path, ball: TriangleMesh
) -> None:
    said: list[str] = []
    fields = OcclusionFields(said.append, tmp_path, waits=False)
    assert fields.find(placed(ball), SETTINGS) is None
    assert "`ball`" in said[0]
    fields.waits = True
    assert fields.find(placed(ball), SETTINGS) is not None


def test_a_folder_that_cannot_be_written_costs_only_the_file(tmp_path: Path, ball: TriangleMesh) -> None:
    (tmp_path / "file").write_text("in the way")
    said: list[str] = []
    assert OcclusionFields(said.append, tmp_path / "file").find(placed(ball), SETTINGS) is not None
    assert "is not kept" in said[0]
