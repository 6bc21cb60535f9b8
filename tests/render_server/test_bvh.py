"""Hierarchy over triangles: holds all of them, and rays find in it what they find by trying every triangle."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from render_server.gpu.program import ComputeProgram
from render_server.passes.mesh_buffers import MeshBuffers
from render_server.passes.object_tree import ObjectTree

from render_server.gpu.context import GpuContext
from render_server.scene.bvh import LEAF_SIZE, Bvh, build_bvh

pytestmark = pytest.mark.usefixtures("clean_gl")
RAYS = 2048
SHADER = Path(__file__).with_name("rays.comp.glsl")


def soup(count: int, seed: int = 0, size: float = 0.1) -> np.ndarray:
    random = np.random.default_rng(seed)
    corners = random.normal(size=(count, 1, 3)) + size * random.normal(size=(count, 3, 3))
    return corners.astype(np.float32)


def torus() -> np.ndarray:
    return np.asarray(trimesh.creation.torus(0.5, 0.2, 48, 24).triangles, np.float32)


def random_rays(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    origins = 2 * random.normal(size=(RAYS, 3))
    ways = 0.7 * random.normal(size=(RAYS, 3)) - origins
    return origins.astype(np.float32), (ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)


def brute_force(corners: np.ndarray, origins: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Distance to the closest triangle in double precision, infinite where there is none."""
    first, e1, e2 = (
        v.astype(np.float64) for v in (corners[:, 0], *np.swapaxes(corners[:, 1:] - corners[:, :1], 0, 1))
    )
    closest = np.full(len(origins), np.inf)
    for index, (origin, way) in enumerate(
        zip(origins.astype(np.float64), ways.astype(np.float64), strict=True)
    ):
        p = np.cross(way, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / np.einsum("ij,ij->i", e1, p)
            s = origin - first
            q = np.cross(s, e1)
            u, v = np.einsum("ij,ij->i", s, p) * inverse, q @ way * inverse
            t = np.einsum("ij,ij->i", e2, q) * inverse
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        closest[index] = t[met].min(initial=np.inf)
    return closest


def traced(
    gpu: GpuContext, corners: np.ndarray, origins: np.ndarray, ways: np.ndarray, tree: Bvh | None = None
) -> np.ndarray:
    """Rows of (distance, triangle, two barycentric coordinates)."""
    tree = tree or build_bvh(corners)
    rows = np.zeros((len(origins), 2, 4), np.float32)
    rows[:, 0, :3], rows[:, 1, :3] = origins, ways
    contents = [rows.tobytes(), bytes(16 * len(origins)), tree.packed(), tree.packed_triangles(corners)]
    buffers = [gpu.ctx.buffer(content) for content in contents]
    for binding, buffer in enumerate(buffers):
        buffer.bind_to_storage_buffer(binding)
    program = ComputeProgram(gpu, SHADER)
    program.run((len(origins),), count=len(origins))
    found = np.frombuffer(buffers[1].read(), np.float32).reshape(-1, 4)
    program.release()
    for buffer in buffers:
        buffer.release()
    return found


def descendants(tree: Bvh, node: int) -> slice:
    return slice(node, int(tree.skip[node]))


@pytest.mark.parametrize("corners", [soup(3000), torus(), soup(1), soup(LEAF_SIZE + 1)], ids=len)
def test_rays_find_the_closest_triangle(gpu: GpuContext, corners: np.ndarray) -> None:
    origins, ways = random_rays()
    found, expected = traced(gpu, corners, origins, ways), brute_force(corners, origins, ways)
    hit = found[:, 1] >= 0
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    np.testing.assert_allclose(found[both, 0], expected[both], rtol=1e-4, atol=1e-4)
    triangle, (u, v) = found[both, 1].astype(int), found[both, 2:].T
    weights = np.stack([1 - u - v, u, v], axis=1)
    places = np.einsum("ij,ijk->ik", weights, corners[triangle])
    np.testing.assert_allclose(places, origins[both] + found[both, :1] * ways[both], atol=1e-3)


def test_rays_do_not_slip_into_a_closed_mesh(gpu: GpuContext) -> None:
    ball = np.asarray(trimesh.creation.icosphere(4, 0.5).triangles, np.float32)
    origins, _ = random_rays()
    origins *= np.float32(3) / np.linalg.norm(origins, axis=1, keepdims=True)
    vertices = np.unique(ball.reshape(-1, 3), axis=0)
    ways = (
        0.8 * vertices[np.arange(RAYS) % len(vertices)] - origins
    )  # through a smaller ball, many along edges
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    found = traced(gpu, ball, origins, ways.astype(np.float32))
    assert (found[:, 1] >= 0).all()
    assert found[:, 0].max() < 3.0, "the near side was met"


@pytest.mark.parametrize("corners", [soup(2500), torus(), np.repeat(soup(1), 100, axis=0)], ids=len)
def test_every_triangle_is_in_one_leaf_and_boxes_enclose_what_is_below(corners: np.ndarray) -> None:
    tree = build_bvh(corners)
    np.testing.assert_array_equal(np.sort(tree.order), np.arange(len(corners)))
    leaves = np.flatnonzero(tree.leaf >= 0)
    counts = tree.leaf[leaves] & 7
    assert counts.max() <= LEAF_SIZE
    np.testing.assert_array_equal(tree.leaf[leaves] >> 3, np.cumsum(counts) - counts)
    for node in range(len(tree.skip)):
        below = descendants(tree, node)
        assert (tree.low[node] <= tree.low[below]).all()
        assert (tree.high[node] >= tree.high[below]).all()
        inside = leaves[(leaves >= below.start) & (leaves < below.stop)]
        first, last = tree.leaf[inside[0]] >> 3, (tree.leaf[inside[-1]] >> 3) + (tree.leaf[inside[-1]] & 7)
        held = corners[tree.order[first:last]]
        assert (held >= tree.low[node]).all()
        assert (held <= tree.high[node]).all()


def test_same_triangles_give_the_same_tree() -> None:
    one, other = build_bvh(soup(2000)), build_bvh(soup(2000))
    assert one.packed() == other.packed()
    assert one.packed_triangles(soup(2000)) == other.packed_triangles(soup(2000))


def test_rays_meet_few_boxes_of_a_large_mesh() -> None:
    """A ray through a mesh of 80 000 triangles must stay far below llvmpipe's limit of 65 535 turns of loops."""
    ball = np.asarray(trimesh.creation.icosphere(6, 0.5).triangles, np.float32)
    tree = build_bvh(ball)
    origins, ways = random_rays()
    most = max(_boxes_met(tree, origin, way) for origin, way in zip(origins[:50], ways[:50], strict=True))
    assert most < 2000


def _boxes_met(tree: Bvh, origin: np.ndarray, way: np.ndarray) -> int:
    """Turns of the loop where nothing hides what lies behind it."""
    near = np.minimum((tree.low - origin) / way, (tree.high - origin) / way).max(axis=1)
    far = np.maximum((tree.low - origin) / way, (tree.high - origin) / way).min(axis=1)
    met, node, turns = (near <= far) & (far >= 0), 0, 0
    while node < len(tree.skip):
        turns += 1
        node = node + 1 if met[node] else int(tree.skip[node])
    return turns


def test_a_refitted_tree_is_the_built_one_and_finds_what_moved(gpu: GpuContext) -> None:
    corners = torus()
    tree = build_bvh(corners)
    same = tree.refitted(corners)
    assert (same.packed(), same.cost) == (tree.packed(), tree.cost)
    bent = corners + np.float32(0.3) * np.sin(4 * corners[..., [1, 2, 0]])
    moved = tree.refitted(bent)
    assert moved.cost < 2 * build_bvh(bent).cost
    origins, ways = random_rays()
    found, expected = traced(gpu, bent, origins, ways, moved), brute_force(bent, origins, ways)
    hit = found[:, 1] >= 0
    assert np.mean(hit != np.isfinite(expected)) < 0.002, "only rays along an edge may differ"
    both = hit & np.isfinite(expected)
    np.testing.assert_allclose(found[both, 0], expected[both], rtol=1e-4, atol=1e-4)


def test_a_refitted_tree_of_shuffled_triangles_is_worn(gpu: GpuContext) -> None:
    """What has the same number of triangles but nothing in common costs so much that it is built anew."""
    corners = torus()
    shuffled = np.random.default_rng(0).permutation(corners)
    assert build_bvh(corners).refitted(shuffled).cost > 10 * build_bvh(corners).cost
    follower = ObjectTree(gpu)
    empty = MeshBuffers(gpu)
    bounds = (corners.min(axis=(0, 1)), corners.max(axis=(0, 1)))
    for version, each in enumerate((corners, shuffled), start=1):
        follower.follow(version, each, bounds, empty)
        assert follower._renewed().cost == pytest.approx(build_bvh(each).cost)
    follower.release()
    empty.release()
