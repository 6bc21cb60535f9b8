"""Voxelisation is exact: no area is lost or made, and a closed mesh gives a closed shell (docs/method.md 4.2)."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.clearing import clear_buffer, clear_volume
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import watched
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.passes.split_injection import FilterIsotropic
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement, place_volume
from deltalight.render_server.passes.voxelize import (
    LONGEST_EDGE_VOXELS,
    EarlierCounts,
    Voxelize,
    VoxelizedMesh,
)
from deltalight.render_server.passes.voxels import (
    DIRECTIONS,
    SURFEL_BYTES,
    SURFELS_HEADER_BYTES,
    ClearVoxels,
    FilterVoxels,
    VoxelMipmap,
    VoxelStore,
)
from deltalight.render_server.scene.depth_mesh import BACK_OFFSET_VOXELS, back_faces
from deltalight.render_server.scene.gpu_mesh import GpuMesh, merge_for_gpu
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.scene.triangle_splitting import split_triangles
from tests.render_server.voxel_lab import VoxelLab, gpu_mesh

pytestmark = pytest.mark.usefixtures("clean_gl")
SIZE = 64


@pytest.fixture(scope="module")
def lab(gpu: GpuContext) -> Iterator[VoxelLab]:
    made = VoxelLab(gpu, SIZE)
    yield made
    made.release()


def soup(rng: np.random.Generator, count: int, spread: tuple[float, float, float]) -> trimesh.Trimesh:
    """Triangles about random points inside the volume; `spread`: extents along random axes, voxels."""
    turns = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(count)])
    corners = rng.uniform(-0.5, 0.5, (count, 3, 3)) * np.array(spread)
    corners = np.einsum("nij,nkj->nki", turns, corners)
    room = np.abs(corners).max(axis=1)
    corners += rng.uniform(room + 0.01, SIZE - 0.01 - room)[:, None]
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), process=False)


KINDS: dict[str, Any] = {
    "large": (30, (30.0, 30.0, 30.0)),
    "voxel-sized": (400, (1.5, 1.5, 1.5)),
    "tiny": (2000, (0.05, 0.05, 0.05)),
    "thin": (200, (20.0, 0.02, 0.02)),
    "long and thin": (40, (50.0, 0.3, 0.0)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_area_is_kept(lab: VoxelLab, kind: str) -> None:
    mesh = soup(np.random.default_rng(len(kind)), *KINDS[kind])
    positions, areas, normals, voxels = lab.surfels(gpu_mesh(mesh))
    assert np.isfinite(positions).all()
    assert np.isfinite(normals).all()
    assert areas.min() > 0
    assert areas.sum(dtype=np.float64) == pytest.approx(mesh.area, rel=1e-3)
    centre = np.average(positions.astype(np.float64), axis=0, weights=areas)
    assert np.abs(centre - np.average(mesh.triangles_center, axis=0, weights=mesh.area_faces)).max() < 2e-3
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-5
    assert (positions > voxels - 1e-4).all()
    assert (positions < voxels + 1 + 1e-4).all()


def test_area_outside_the_volume_is_cut_off(lab: VoxelLab) -> None:
    """A plane that reaches far beyond keeps the volume's cross-section."""
    plane = trimesh.Trimesh(np.array([[-500, -400, 20.3], [900, -400, 20.3], [30, 1500, 20.3]]), [[0, 1, 2]])
    _, areas, _, voxels = lab.surfels(gpu_mesh(plane))
    assert areas.sum(dtype=np.float64) == pytest.approx(SIZE**2, rel=1e-3)
    assert set(voxels[:, 2]) == {20}


def test_mesh_outside_the_volume_leaves_nothing(lab: VoxelLab) -> None:
    sphere = trimesh.creation.icosphere(2, 5.0)
    sphere.apply_translation((-20, 30, 30))
    assert len(lab.surfels(gpu_mesh(sphere))[1]) == 0


@pytest.mark.parametrize("height", [20.0, 20.5, 21.0, 0.0])
def test_aligned_plane_covers_its_voxels_once(lab: VoxelLab, height: float) -> None:
    """Also where it lies on the border between voxels."""
    plane = trimesh.Trimesh(
        np.array([[0, 0, height], [SIZE, 0, height], [SIZE, SIZE, height], [0, SIZE, height]]),
        [[0, 1, 2], [0, 2, 3]],
    )
    voxels = lab.fill(gpu_mesh(plane, 1.0))
    texels = lab.level_zero(voxels)
    voxels.release()
    seen_from_above = texels[5, ..., 3]  # the cone travels down
    assert np.abs(seen_from_above[int(height)] - 1).max() < 2e-3
    assert np.count_nonzero(texels[..., 3]) == SIZE**2
    assert np.abs(texels[5, int(height), ..., 0] - 1).max() < 2e-3


def test_a_sample_that_meets_anything_counts_as_occupied(lab: VoxelLab) -> None:
    """Of each level, a bit for each corner of cells: set if one of the eight around it is touched."""
    ball = trimesh.creation.icosphere(3, 9.0)
    ball.apply_translation((30.3, 31.6, 12.2))
    voxels = lab.fill(gpu_mesh(ball, 1.0))
    bits = np.unpackbits(np.frombuffer(voxels.rho.occupied.read(), np.uint8), bitorder="little")
    voxels.release()
    covered, first = np.zeros((SIZE,) * 3, bool), 0
    covered[tuple(lab.surfels(gpu_mesh(ball))[3].T[::-1])] = True
    for level in range(lab.placement.levels):
        cells = SIZE >> level
        padded = np.pad(covered, 1)
        corners = np.logical_or.reduce(
            [
                padded[z : z + cells + 1, y : y + cells + 1, x : x + cells + 1]
                for z, y, x in np.ndindex(2, 2, 2)
            ]
        )
        row = 32 * (cells // 32 + 1)
        held = bits[first : first + (cells + 1) ** 2 * row].reshape(cells + 1, cells + 1, row)
        assert np.array_equal(held[..., : cells + 1], corners)
        half = SIZE // 2
        first += held.size if level == 0 else (half + 1) ** 2 * 32 * (half // 32 + 1)
        covered = np.any(covered.reshape(cells // 2, 2, cells // 2, 2, cells // 2, 2), axis=(1, 3, 5))


@pytest.mark.parametrize("edge", [0.12, 0.07, 0.3])
def test_faces_on_borders_of_voxels_keep_their_area(gpu: GpuContext, edge: float) -> None:
    """But for rounding."""
    box = trimesh.creation.box((edge,) * 3)
    low, high = box.bounds
    placement = place_volume(low, high, SIZE, None)
    store, volume, voxelize = VoxelStore(gpu, SIZE), PlacedVolume(gpu, placement), Voxelize(gpu)
    mesh = MeshBuffers(gpu)
    mesh.write(gpu_mesh(box))
    voxelize.run(store, [VoxelizedMesh(mesh)], volume)
    _, count = store.counts()
    content = store.surfels.read(count * SURFEL_BYTES, offset=SURFELS_HEADER_BYTES)
    areas = np.frombuffer(content, np.float32).reshape(-1, SURFEL_BYTES // 4)[:, 3]
    assert areas.sum(dtype=np.float64) == pytest.approx(box.area, rel=1e-5)
    for item in (store, volume, voxelize, mesh):
        item.release()


def sorted_surfels(
    lab: VoxelLab, mesh: GpuMesh, behind_m: float = 0.0, chosen: np.ndarray | None = None
) -> np.ndarray:
    positions, areas, normals, voxels = lab.surfels(mesh, behind_m, chosen)
    rows = np.column_stack([positions, areas, normals, voxels])
    return rows[np.lexsort(rows.T)]


def of_corners(corners: np.ndarray) -> GpuMesh:
    """A mesh of loose triangles (m, 3, 3) as they are."""
    positions = np.ascontiguousarray(corners.reshape(-1, 3), np.float32)
    triangles = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    return merge_for_gpu([TriangleMesh(positions, np.zeros_like(positions), triangles, None, Material())])


def test_long_triangles_are_cut_into_the_pieces_of_the_mesh_code(gpu: GpuContext) -> None:
    """To the bit, with more pieces than there is room for at first, and no earlier filling to go by."""
    lab = VoxelLab(gpu, SIZE)
    rng = np.random.default_rng(5)
    corners = np.concatenate(
        [
            rng.uniform(-20, SIZE + 20, (40, 3, 3)),
            rng.uniform(-400, 400, (3, 3, 3)) + SIZE / 2,
            rng.uniform(0, SIZE, (100, 1, 3)) + rng.uniform(-3, 3, (100, 3, 3)),
        ]
    ).astype(np.float32)
    pieces = split_triangles(corners, LONGEST_EDGE_VOXELS)
    assert len(pieces) > 4096
    found = sorted_surfels(lab, of_corners(corners))
    assert len(found) > 10_000
    assert np.array_equal(found, sorted_surfels(lab, of_corners(pieces)))
    lab.release()


def test_backs_are_those_of_the_mesh_code(gpu: GpuContext, lab: VoxelLab) -> None:
    """To the bit in software; GPUs may round divisions and roots otherwise."""
    rng = np.random.default_rng(6)
    corners = rng.uniform(5, SIZE - 5, (300, 1, 3)) + rng.uniform(-4, 4, (300, 3, 3))
    mesh = of_corners(corners)
    backs = back_faces(mesh.corners, 1.0)
    found, wanted = sorted_surfels(lab, mesh, BACK_OFFSET_VOXELS), sorted_surfels(lab, of_corners(backs))
    if gpu.is_software:
        assert np.array_equal(found, wanted)
    assert len(found) == pytest.approx(len(wanted), rel=1e-3)
    np.testing.assert_allclose(found[:, :4].mean(axis=0), wanted[:, :4].mean(axis=0), rtol=1e-4)


def test_chosen_triangles_alone_are_voxelised(lab: VoxelLab) -> None:
    mesh = gpu_mesh(soup(np.random.default_rng(7), 50, (5.0, 5.0, 5.0)))
    chosen = np.array([3, 17, 18, 44], np.int32)
    wanted = sorted_surfels(lab, replace(mesh, triangles=mesh.triangles[chosen]))
    assert np.array_equal(sorted_surfels(lab, mesh, chosen=chosen), wanted)


def test_parts_of_a_mesh_fill_several_volumes_together(gpu: GpuContext) -> None:
    """A part and backs of a mesh, long triangles among them, in two volumes: as each alone in each volume."""
    placements = VolumePlacement((0.0, 0.0, 0.0), 1.0, SIZE), VolumePlacement((7.0, 3.0, 11.0), 0.5, SIZE)
    volume, voxelize, mesh = PlacedVolume(gpu, *placements), Voxelize(gpu), MeshBuffers(gpu)
    mesh.write(gpu_mesh(soup(np.random.default_rng(11), 60, (14.0, 14.0, 14.0))))
    chosen = np.array([0, 4, 19], np.int32)
    parts = (
        VoxelizedMesh(mesh, triangles=range(5, 40)),
        VoxelizedMesh(mesh, 2.0, chosen, range(40, 60)),
    )
    store = VoxelStore(gpu, SIZE)

    def surfels(*meshes: Sequence[VoxelizedMesh]) -> np.ndarray:
        store.resize(SIZE, len(placements))
        voxelize.run_all(store, meshes, volume)
        _, count = store.counts()
        rows = np.frombuffer(store.surfels.read(count * SURFEL_BYTES, offset=SURFELS_HEADER_BYTES), np.uint32)
        return rows.reshape(count, -1)

    runs: Counter[str] = Counter()
    with watched(gpu, lambda run: runs.update([run.kernel.split()[0]])):
        together = surfels(parts, parts)
    assert runs["voxelize"] == 1
    alone = [surfels([part], []) for part in parts] + [surfels([], [part]) for part in parts]
    assert min(map(len, alone)) > 20
    wanted = np.concatenate(alone)
    assert np.array_equal(np.unique(together, axis=0), np.unique(wanted, axis=0))
    assert len(together) == len(wanted)
    release_all(store, volume, voxelize, mesh)


def test_a_gpu_counts_without_being_waited_for(gpu: GpuContext, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the first filling, and for the second after one that had no room for all."""
    lab = VoxelLab(replace(gpu, is_software=False), SIZE)
    few, many = (gpu_mesh(soup(np.random.default_rng(8), 400, (edge,) * 3)) for edge in (1.5, 25.0))
    shown = [few] * 4 + [many] * 6
    waited: list[int] = []
    missing: list[int] = []
    exact = {id(mesh): VoxelLab(gpu, SIZE) for mesh in (few, many)}  # what each has is waited for
    wanted = {id(mesh): len(exact[id(mesh)].surfels(mesh)[1]) for mesh in (few, many)}
    wait = EarlierCounts.wait

    def noted(earlier: EarlierCounts, *given: Any) -> Any:  # noqa: ANN401
        waited.append(len(missing))
        return wait(earlier, *given)

    monkeypatch.setattr(EarlierCounts, "wait", noted)
    for mesh in shown:
        missing.append(wanted[id(mesh)] - len(lab.surfels(mesh)[1]))
    assert set(waited) == {0, 6}
    assert [step for step, count in enumerate(missing) if count] == [4, 5]
    for each in (lab, *exact.values()):
        each.release()


def test_a_volume_whose_voxels_change_a_little_is_not_waited_for(
    gpu: GpuContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coarse volume around everything in view is another one in each frame in which the camera moves."""
    lab = VoxelLab(replace(gpu, is_software=False), SIZE)
    edges = 1.0, 1.02, 1.05, 1.01, 0.8, 0.82  # m
    mesh, waited = gpu_mesh(soup(np.random.default_rng(8), 400, (4.0,) * 3)), set()
    wait = EarlierCounts.wait

    def noted(earlier: EarlierCounts, *given: Any) -> Any:  # noqa: ANN401
        waited.add(lab.placement.voxel_edge)
        return wait(earlier, *given)

    monkeypatch.setattr(EarlierCounts, "wait", noted)
    for edge in edges:
        lab.place(edge)
        lab.surfels(mesh)
    assert waited == {1.0, 0.8}
    lab.release()


@pytest.mark.parametrize(("size", "count"), [(24, 1), (40, 2), (64, 1)])
def test_levels_filtered_together_are_those_of_one_after_the_other(
    gpu: GpuContext, size: int, count: int
) -> None:
    volume = PlacedVolume(gpu, *[VolumePlacement((9.0 * i, 0.0, 0.0), 0.1, size) for i in range(count)])
    mipmap = VoxelMipmap(gpu, size, DIRECTIONS)
    mipmap.resize(size, count)
    mipmap.occupied.write(b"\xff" * mipmap.occupied.size)
    level_zero = np.random.default_rng(2).random((DIRECTIONS * size, size, count * size, 4))
    found = []
    for each in (gpu, replace(gpu, is_software=False)):
        mipmap.texture.write(
            level_zero.astype(np.float16).tobytes(), viewport=(0, 0, 0, *level_zero.shape[2::-1])
        )
        filtering = FilterVoxels(each)
        for _ in range(2):  # the second time, counts of tiles that are done begin anew
            width, height, depth = mipmap.texture.size
            above = (0, 0, DIRECTIONS * size, width, height, depth - DIRECTIONS * size)
            mipmap.texture.write(b"\x3c" * (8 * math.prod(above[3:])), viewport=above)
            filtering.run(mipmap, volume)
            found.append(mipmap.texture.read())
        clear_volume(gpu, mipmap.texture)
        filtering.release()
    assert len(set(found)) == 1
    release_all(mipmap, volume)


@pytest.mark.parametrize(("size", "count"), [(24, 1), (40, 2), (64, 1)])
def test_isotropic_levels_filtered_together_are_those_of_one_after_the_other(
    gpu: GpuContext, size: int, count: int
) -> None:
    """Level 1 also is the mean of the eight cells below each of its own."""
    volume = PlacedVolume(gpu, *[VolumePlacement((9.0 * i, 0.0, 0.0), 0.1, size) for i in range(count)])
    mipmaps = [VoxelMipmap(gpu, size, 1) for _ in range(2)]
    level_zero = np.random.default_rng(3).random((2, size, size, count * size, 4)).astype(np.float16)
    found = []
    for each in (gpu, replace(gpu, is_software=False)):
        filtering = FilterIsotropic(each)
        for _ in range(2):  # the second time, counts of tiles that are done begin anew
            for mipmap, texels in zip(mipmaps, level_zero, strict=True):
                mipmap.resize(size, count)
                mipmap.texture.write(texels.tobytes(), viewport=(0, 0, 0, count * size, size, size))
            filtering.run(mipmaps[0], mipmaps[1], volume)
            found.append([mipmap.texture.read() for mipmap in mipmaps])
        filtering.release()
    assert found[1:] == found[:-1]
    for written, texels in zip(found[0], level_zero, strict=True):
        above = np.frombuffer(written, np.float16).reshape(-1, size, count * size, 4)[size:]
        means = texels.reshape(size // 2, 2, size // 2, 2, -1, 2, 4).astype(np.float32).mean(axis=(1, 3, 5))
        for index in range(count):
            own = above[: size // 2, : size // 2, index * size : index * size + size // 2]
            wanted = means[:, :, index * size // 2 : (index + 1) * size // 2]
            np.testing.assert_allclose(own, wanted, atol=1e-3)
    release_all(*mipmaps, volume)


def test_levels_around_touched_voxels_are_those_of_all_cells(gpu: GpuContext, lab: VoxelLab) -> None:
    """In software, also where the voxels of an earlier mesh were, and where two sets share cells."""
    rng = np.random.default_rng(5)
    volume, mipmap = PlacedVolume(gpu, lab.placement), VoxelMipmap(gpu, SIZE, DIRECTIONS)
    stores = [VoxelStore(gpu, SIZE) for _ in range(2)]
    clearing, filtering = ClearVoxels(gpu, [mipmap]), FilterVoxels(gpu)
    for _ in range(2):
        for store in stores:
            clearing.run(store, volume)
            lab.voxelize(store, gpu_mesh(soup(rng, 60, (9.0, 9.0, 9.0))))
        write_touched(mipmap, stores, rng)
        filtering.run(mipmap, volume, *stores)
    found = mipmap.texture.read()
    filtering.run(mipmap, volume)
    assert found == mipmap.texture.read()
    texels = np.frombuffer(found, np.float16).reshape(-1, SIZE, SIZE, 4)
    assert texels[DIRECTIONS * SIZE :].any()
    release_all(mipmap, volume, clearing, filtering, *stores)


def write_touched(mipmap: VoxelMipmap, stores: list[VoxelStore], rng: np.random.Generator) -> None:
    """Fills the voxels that the stores touched with noise, in all directions of level 0."""
    touched = np.zeros(SIZE**3, bool)
    for store in stores:
        touched |= np.frombuffer(store.grid.read(), np.uint32) > 0
    assert touched.any()
    texels = np.where(touched[:, None], rng.random((DIRECTIONS, SIZE**3, 4)), 0.0).astype(np.float16)
    place = 0, 0, 0, SIZE, SIZE, DIRECTIONS * SIZE  # level 0 of all directions
    mipmap.texture.write(texels.tobytes(), viewport=place)


def test_on_a_gpu_levels_of_empty_cells_are_emptied_without_a_look_below(gpu: GpuContext) -> None:
    size = 32
    volume = PlacedVolume(gpu, VolumePlacement((0.0, 0.0, 0.0), 0.1, size))
    mipmap, filtering = VoxelMipmap(gpu, size, DIRECTIONS), FilterVoxels(replace(gpu, is_software=False))
    mipmap.texture.write(np.ones((*mipmap.texture.size[::-1], 4), np.float16).tobytes())
    clear_buffer(gpu, mipmap.occupied)
    filtering.run(mipmap, volume)
    slabs = np.frombuffer(mipmap.texture.read(), np.float16).reshape(-1, size, size, 4)
    assert (slabs[: DIRECTIONS * size] == 1).all(), "level 0 stays"
    assert not slabs[DIRECTIONS * size :, : size // 2, : size // 2].any()
    release_all(mipmap, volume, filtering)


def test_triangles_of_too_many_voxels_are_refused(gpu: GpuContext) -> None:
    lab = VoxelLab(gpu, SIZE)  # a GPU would tell those of an earlier filling later
    mesh = of_corners(np.array([[[-1e6, -1e6, 20.5], [2e6, -1e6, 20.5], [-1e6, 2e6, 20.5]]]))
    with pytest.raises(DeltalightError, match="use fewer voxels"):
        lab.surfels(mesh)
    lab.release()


TILTED = {
    "through edges of voxels": (0.0, 1.0, 0.0),
    "through corners of voxels": (1.0, 1.0, 0.0),
    "through edges, but for rounding": (1e-7, 1.0 - 1e-7, 0.3e-6),
    "all but level, on the border": (1e-7, -1e-7, 20.0),
    "all but level, across the border": (3e-6, -2e-6, 19.99998),
}


@pytest.mark.parametrize("name", TILTED)
def test_planes_through_edges_of_voxels_count_once(lab: VoxelLab, name: str) -> None:
    """Where outlines of pieces coincide with borders of voxels, exactly or almost."""
    across_x, across_y, height = TILTED[name]
    low, high = 2.0, 26.0
    corners = np.array(
        [(x, y, height + across_x * x + across_y * y) for x in (low, high) for y in (low, high)]
    )
    plane = trimesh.Trimesh(corners, [[0, 2, 3], [0, 3, 1]])
    positions, areas, _, voxels = lab.surfels(gpu_mesh(plane))
    assert areas.sum(dtype=np.float64) == pytest.approx(plane.area, rel=1e-4)
    columns, each = np.unique(voxels[:, :2], axis=0, return_inverse=True)
    assert len(columns) == (high - low) ** 2
    in_columns = np.bincount(each.ravel(), weights=areas)
    assert np.abs(in_columns / np.hypot(1.0, np.hypot(across_x, across_y)) - 1).max() < 0.02
    off_plane = positions[:, 2] - height - positions[:, :2] @ (across_x, across_y)
    assert (np.abs(off_plane) * areas).max() < 1e-5  # where a sliver lies does not matter


CLOSED = {
    "ball": trimesh.creation.icosphere(3, 20.3),
    "torus": trimesh.creation.torus(16.0, 6.0),
    "box": trimesh.creation.box((30.3, 21.7, 25.1)),
}


@pytest.mark.parametrize("name", CLOSED)
def test_closed_mesh_gives_a_shell_that_does_not_leak(lab: VoxelLab, name: str) -> None:
    """A flood through the six neighbours from outside leaves the inside: the mesh's volume lies between the untouched
    voxels that remain and those with the shell."""
    mesh = CLOSED[name].copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 0.5)))
    mesh.apply_translation(np.array((32.2, 31.9, 32.4)) - mesh.bounds.mean(axis=0))
    _, _, _, voxels = lab.surfels(gpu_mesh(mesh))
    touched = np.zeros((SIZE,) * 3, bool)
    touched[tuple(voxels.T)] = True
    regions, _ = ndimage.label(~touched)
    inside = np.count_nonzero(~touched & (regions != regions[0, 0, 0]))
    assert inside < mesh.volume < inside + np.count_nonzero(touched)
    assert inside > 0.5 * mesh.volume
