"""Hierarchy over triangles: holds all of them, and rays find in it what they find by trying every triangle."""

import sys
from importlib.util import find_spec
from pathlib import Path

import moderngl
import numpy as np
import pytest
import trimesh

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.passes.object_bvh import BvhTextures, ObjectBvh
from deltalight.render_server.scene.bvh import COUNT_BITS, LEAF_SIZE, ROUNDING, Bvh, RayCaster, build_bvh
from deltalight.render_server.scene.bvh_forest import BvhForest, Forest, lone_tree
from deltalight.render_server.scene.gpu_mesh import GpuMesh, merge_for_gpu, merge_parts, merged_again
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import TriangleMesh

pytestmark = pytest.mark.usefixtures("clean_gl")
RAYS = 2048
SHADER = Path(__file__).with_name("rays")
MATERIAL = Material()
UNREAD: Bindings = {
    "Vertices": None,
    "Materials": None,
    "MATERIAL_MAPS": False,
    "CUTOUTS": False,
    "HIDES_BACKS": False,
    "EXTENDED": False,
}  # what the surface at a hit is like


def soup(count: int, seed: int = 0, size: float = 0.1) -> np.ndarray:
    random = np.random.default_rng(seed)
    corners = random.normal(size=(count, 1, 3)) + size * random.normal(size=(count, 3, 3))
    return corners.astype(np.float32)


def torus() -> np.ndarray:
    return np.asarray(trimesh.creation.torus(0.5, 0.2, 48, 24).triangles, np.float32)


def vertices_of(corners: np.ndarray) -> np.ndarray:
    """Each corner is a vertex of its own."""
    return np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)


def triangle_mesh_of(corners: np.ndarray) -> TriangleMesh:
    """Each corner is a vertex of its own."""
    positions = corners.reshape(-1, 3)
    return TriangleMesh(positions, np.zeros_like(positions), vertices_of(corners), None, MATERIAL)


def mesh_of(corners: np.ndarray) -> GpuMesh:
    """Each corner is a vertex of its own."""
    return merge_for_gpu([triangle_mesh_of(corners)])


def random_rays(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    origins = 2 * random.normal(size=(RAYS, 3))
    directions = 0.7 * random.normal(size=(RAYS, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def brute_force(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to the closest triangle in double precision, infinite where there is none."""
    first, e1, e2 = (
        v.astype(np.float64) for v in (corners[:, 0], *np.swapaxes(corners[:, 1:] - corners[:, :1], 0, 1))
    )
    closest = np.full(len(origins), np.inf)
    for index, (origin, direction) in enumerate(
        zip(origins.astype(np.float64), directions.astype(np.float64), strict=True)
    ):
        p = np.cross(direction, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / np.einsum("ij,ij->i", e1, p)
            s = origin - first
            q = np.cross(s, e1)
            u, v = np.einsum("ij,ij->i", s, p) * inverse, q @ direction * inverse
            t = np.einsum("ij,ij->i", e2, q) * inverse
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        closest[index] = t[met].min(initial=np.inf)
    return closest


def traced(
    gpu: GpuContext, corners: np.ndarray, origins: np.ndarray, directions: np.ndarray, bvh: Bvh | None = None
) -> np.ndarray:
    """Rows of (distance, triangle, two barycentric coordinates)."""
    bvh = bvh or build_bvh(corners)
    textures = BvhTextures(gpu)
    textures.write(lone_tree(mesh_of(corners).parts[0], bvh))
    found = hits_in(gpu, textures, origins, directions)
    textures.release()
    met = found[:, 1] >= 0
    found[met, 1] = bvh.order[found[met, 1].astype(int)]
    return found


def hits_in(
    gpu: GpuContext, textures: BvhTextures, origins: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Rows of (distance, triangle in the order of the hierarchy, two barycentric coordinates)."""
    rows = np.zeros((len(origins), 2, 4), np.float32)
    rows[:, 0, :3], rows[:, 1, :3] = origins, directions
    rays, hits = (gpu.ctx.buffer(content) for content in (rows.tobytes(), bytes(16 * len(origins))))
    kernel = Kernel(gpu, SHADER)
    kernel.run((len(origins),), UNREAD, textures.bindings, Rays=rays, Hits=hits, count=len(origins))
    found = np.frombuffer(hits.read(), np.float32).reshape(-1, 4).copy()
    release_all(kernel, rays, hits)
    return found


def descendants(bvh: Bvh, node: int) -> slice:
    return slice(node, int(bvh.skip[node]))


@pytest.mark.parametrize("corners", [soup(3000), torus(), soup(1), soup(LEAF_SIZE + 1)], ids=len)
def test_rays_find_the_closest_triangle(gpu: GpuContext, corners: np.ndarray) -> None:
    origins, directions = random_rays()
    found, expected = traced(gpu, corners, origins, directions), brute_force(corners, origins, directions)
    hit = found[:, 1] >= 0
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    np.testing.assert_allclose(found[both, 0], expected[both], rtol=1e-4, atol=1e-4)
    triangle, (u, v) = found[both, 1].astype(int), found[both, 2:].T
    weights = np.stack([1 - u - v, u, v], axis=1)
    points = np.einsum("ij,ijk->ik", weights, corners[triangle])
    np.testing.assert_allclose(points, origins[both] + found[both, :1] * directions[both], atol=1e-3)


def test_what_lies_before_the_first_triangle_is_none(gpu: GpuContext) -> None:
    """Inner nodes hold -1: three texels back from row 0 are those of other triangles, at the end of that row."""
    corners = soup(3000)
    bvh = build_bvh(corners)
    faces = bvh.packed_triangles(corners.reshape(-1, 3), vertices_of(corners))
    packed = faces.reshape(-1, 4)
    corner, first_edge, second_edge = packed[1021:1024, :3]
    origins, _ = random_rays()
    share = np.random.default_rng(2).dirichlet((1, 1, 1), RAYS)[:, 1:]
    directions = corner + share @ np.stack([first_edge, second_edge]) - origins
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    found, expected = (
        traced(gpu, corners, origins, directions, bvh),
        brute_force(corners, origins, directions),
    )
    hit = found[:, 1] >= 0
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    np.testing.assert_allclose(found[both, 0], expected[both], rtol=1e-4, atol=1e-4)


def test_rays_do_not_slip_into_a_closed_mesh(gpu: GpuContext) -> None:
    ball = np.asarray(trimesh.creation.icosphere(4, 0.5).triangles, np.float32)
    origins, _ = random_rays()
    origins *= np.float32(3) / np.linalg.norm(origins, axis=1, keepdims=True)
    vertices = np.unique(ball.reshape(-1, 3), axis=0)
    directions = (
        0.8 * vertices[np.arange(RAYS) % len(vertices)] - origins
    )  # through a smaller ball, many along edges
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = traced(gpu, ball, origins, directions.astype(np.float32))
    assert (found[:, 1] >= 0).all()
    assert found[:, 0].max() < 3.0, "the near side was met"


@pytest.mark.parametrize("corners", [soup(2500), torus(), np.repeat(soup(1), 100, axis=0)], ids=len)
def test_every_triangle_is_in_one_leaf_and_boxes_enclose_what_is_below(corners: np.ndarray) -> None:
    bvh = build_bvh(corners)
    np.testing.assert_array_equal(np.sort(bvh.order), np.arange(len(corners)))
    leaves = np.flatnonzero(bvh.leaf >= 0)
    counts = bvh.leaf[leaves] & 7
    assert counts.max() <= LEAF_SIZE
    np.testing.assert_array_equal(bvh.leaf[leaves] >> 3, np.cumsum(counts) - counts)
    for node in range(len(bvh.skip)):
        below = descendants(bvh, node)
        assert (bvh.low[node] <= bvh.low[below]).all()
        assert (bvh.high[node] >= bvh.high[below]).all()
        inside = leaves[(leaves >= below.start) & (leaves < below.stop)]
        first, last = bvh.leaf[inside[0]] >> 3, (bvh.leaf[inside[-1]] >> 3) + (bvh.leaf[inside[-1]] & 7)
        held = corners[bvh.order[first:last]]
        assert (held >= bvh.low[node]).all()
        assert (held <= bvh.high[node]).all()


def test_same_triangles_give_the_same_bvh() -> None:
    one, other = build_bvh(soup(2000)), build_bvh(soup(2000))
    assert one.packed().tobytes() == other.packed().tobytes()
    positions, triangles = soup(2000).reshape(-1, 3), vertices_of(soup(2000))
    packed = [bvh.packed_triangles(positions, triangles) for bvh in (one, other)]
    assert packed[0].tobytes() == packed[1].tobytes()


def test_packed_triangles_name_their_vertices() -> None:
    positions = soup(33).reshape(-1, 3)
    vertices = np.random.default_rng(5).integers(0, 99, (50, 3)).astype(np.int32)
    corners = positions[vertices]
    bvh = build_bvh(corners)
    rows = bvh.packed_triangles(positions, vertices)
    np.testing.assert_array_equal(rows.view(np.int32)[:, :, 3], vertices[bvh.order])
    np.testing.assert_array_equal(rows[:, 0, :3], corners[bvh.order, 0])
    np.testing.assert_array_equal(rows[:, 1:, :3], (corners[:, 1:] - corners[:, :1])[bvh.order])


def test_rays_meet_few_boxes_of_a_large_mesh() -> None:
    """A ray through a mesh of 80 000 triangles must stay far below llvmpipe's limit of 65 535 turns of loops."""
    ball = np.asarray(trimesh.creation.icosphere(6, 0.5).triangles, np.float32)
    bvh = build_bvh(ball)
    origins, directions = random_rays()
    some = zip(origins[:50], directions[:50], strict=True)
    assert max(_boxes_met(bvh, *ray) for ray in some) < 2000


def _boxes_met(bvh: Bvh, origin: np.ndarray, direction: np.ndarray) -> int:
    """Turns of the loop where nothing hides what lies behind it."""
    near = np.minimum((bvh.low - origin) / direction, (bvh.high - origin) / direction).max(axis=1)
    far = np.maximum((bvh.low - origin) / direction, (bvh.high - origin) / direction).min(axis=1)
    met, node, turns = (near <= far) & (far >= 0), 0, 0
    while node < len(bvh.skip):
        turns += 1
        node = node + 1 if met[node] else int(bvh.skip[node])
    return turns


def test_a_refitted_bvh_is_the_built_one_and_finds_what_moved(gpu: GpuContext) -> None:
    corners = torus()
    bvh = build_bvh(corners)
    same = bvh.refitted(corners)
    assert (same.packed().tobytes(), same.cost) == (bvh.packed().tobytes(), bvh.cost)
    bent = corners + np.float32(0.3) * np.sin(4 * corners[..., [1, 2, 0]])
    moved = bvh.refitted(bent)
    assert moved.cost < 2 * build_bvh(bent).cost
    origins, directions = random_rays()
    found, expected = traced(gpu, bent, origins, directions, moved), brute_force(bent, origins, directions)
    hit = found[:, 1] >= 0
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    np.testing.assert_allclose(found[both, 0], expected[both], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 5, 700])
def test_each_box_of_a_refitted_bvh_just_holds_its_triangles(count: int) -> None:
    moved = build_bvh(soup(count)).refitted(soup(count, seed=1))
    leaves = moved.leaf >= 0
    held = np.where(leaves, moved.leaf & ((1 << COUNT_BITS) - 1), 0)
    firsts = np.concatenate([[0], np.cumsum(held)])
    corners = soup(count, seed=1)[moved.order]
    margin = np.float32(ROUNDING * float(np.abs(corners).max()))
    for node, (low, high) in enumerate(zip(moved.low, moved.high, strict=True)):
        own = corners[firsts[node] : firsts[moved.skip[node]]]
        np.testing.assert_array_equal(low, own.min(axis=(0, 1)) - margin)
        np.testing.assert_array_equal(high, own.max(axis=(0, 1)) + margin)


def test_a_refitted_bvh_of_shuffled_triangles_is_worn(gpu: GpuContext) -> None:
    """What has the same number of triangles but nothing in common costs so much that it is built anew."""
    corners = torus()
    shuffled = np.random.default_rng(0).permutation(corners)
    assert build_bvh(corners).refitted(shuffled).cost > 10 * build_bvh(corners).cost
    objects = ObjectBvh(gpu)
    mesh = MeshBuffers(gpu)
    bounds = (corners.min(axis=(0, 1)), corners.max(axis=(0, 1)))
    for each in (corners, shuffled):
        objects.set_triangles(mesh_of(each), bounds, mesh)
        nodes = objects.bindings["bvh_nodes"]
        assert isinstance(nodes, moderngl.Texture)
        packed = build_bvh(each).packed().tobytes()
        assert nodes.read()[: len(packed)] == packed
    objects.release()
    mesh.release()


def cluster(number: int, offset: float = 0.0) -> np.ndarray:
    """A small soup at a place of its own."""
    place = np.random.default_rng(number).normal(size=3) + offset
    return (0.2 * soup(200 + number, seed=number) + place).astype(np.float32)


def assert_hits_are_closest(
    hits: np.ndarray, corners: np.ndarray, rays: tuple[np.ndarray, np.ndarray]
) -> None:
    expected = brute_force(corners, *rays)
    hit = hits[:, 1] >= 0
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    assert both.any()
    np.testing.assert_allclose(hits[both, 0], expected[both], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [2, 5, 30])
def test_rays_find_the_closest_triangle_of_several_parts(gpu: GpuContext, count: int) -> None:
    """Also where one has moved far away since, where one is gone, and where one came."""
    groups = [[triangle_mesh_of(cluster(number))] for number in range(count)]
    moved = [*groups[:-1], [groups[-1][0].changed(positions=cluster(count - 1, 2.0).reshape(-1, 3))]]
    first = merge_parts(groups)
    meshes = first, merged_again(first, groups, moved), merge_parts(moved[1:]), merge_parts(moved)
    forest, textures, rays = BvhForest(), BvhTextures(gpu), random_rays()
    for mesh in meshes:
        textures.write(forest.fitted_to(mesh.parts))
        assert_hits_are_closest(hits_in(gpu, textures, *rays), mesh.corners, rays)
    textures.release()


def nodes_of(forest: Forest) -> np.ndarray:
    """All nodes of a forest in their order, as they are packed."""
    rows = np.full((forest.node_count, 8), np.nan, np.float32)
    rows[forest.above_at] = forest.above
    for tree in forest.trees:
        own = tree.bvh.packed(tree.first_node, tree.part.first_triangle)
        rows[tree.first_node : tree.first_node + len(own)] = own
    return rows


def test_boxes_of_a_forest_enclose_what_is_below_and_skip_it() -> None:
    parts = merge_parts([[triangle_mesh_of(cluster(number))] for number in range(23)]).parts
    rows = nodes_of(BvhForest().fitted_to(parts))
    low, high, skip = rows[:, :3], rows[:, 4:7], rows.view(np.int32)[:, 7]
    assert np.isfinite(low).all()
    for node, after in enumerate(skip.tolist()):
        assert node < after <= len(rows)
        assert (low[node] <= low[node:after]).all()
        assert (high[node] >= high[node:after]).all()
    leaves = rows.view(np.int32)[:, 3]
    held = [np.arange(leaf >> COUNT_BITS, (leaf >> COUNT_BITS) + (leaf & 7)) for leaf in leaves[leaves >= 0]]
    total = sum(len(part.triangles) for part in parts)
    np.testing.assert_array_equal(np.sort(np.concatenate(held)), np.arange(total))


def test_parts_that_rest_keep_their_hierarchy() -> None:
    groups = [[triangle_mesh_of(cluster(number))] for number in range(6)]
    before = merge_parts(groups)
    moved = [*groups[:2], [groups[2][0].changed(positions=cluster(2, 0.05).reshape(-1, 3))], *groups[3:]]
    forest = BvhForest()
    old = {tree.part: tree for tree in forest.fitted_to(before.parts).trees}
    new = {tree.part: tree for tree in forest.fitted_to(merged_again(before, groups, moved).parts).trees}
    assert len(new) == 6
    assert len(set(old.values()) & set(new.values())) == 5


RAY_PACKAGES = {"embreex": "embreex.mesh_construction", "igl": "igl.embree"}


def only(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if no other package that casts rays were installed."""
    for name, module in RAY_PACKAGES.items():
        if name != package:
            monkeypatch.setitem(sys.modules, module, None)


@pytest.mark.parametrize("package", RAY_PACKAGES)
def test_each_package_casts_rays_as_every_triangle_says(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed (it has no wheel for this machine, or the set-up is old)")
    only(package, monkeypatch)
    corners, (origins, directions) = torus(), random_rays()
    found = RayCaster(corners.reshape(-1, 3), vertices_of(corners)).cast(
        origins.astype(np.float32), directions.astype(np.float32)
    )
    expected = brute_force(corners, origins, directions)
    hit = found.triangle >= 0
    assert 0.1 < hit.mean() < 0.9
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    weights = np.stack([1 - found.u - found.v, found.u, found.v], axis=1)[both]
    places = np.einsum("hk,hkc->hc", weights, corners[found.triangle[both]])
    distances = np.einsum("hc,hc->h", places - origins[both], directions[both])
    np.testing.assert_allclose(distances, expected[both], rtol=1e-4, atol=1e-4)


def test_without_any_package_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    only("none", monkeypatch)
    with pytest.raises(DeltalightError, match="-m pip install embreex"):
        RayCaster(torus().reshape(-1, 3), vertices_of(torus()))
