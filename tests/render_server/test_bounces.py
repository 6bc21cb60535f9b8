"""Light gathered from voxel to voxel, against closed forms (docs/method.md 4.3)."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from deltalight.protocol.frames import BoardPose, ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.voxel_light import BounceTail
from deltalight.render_server.passes.voxels import VoxelMipmap
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    GREY,
    Stage,
    ambient,
    cube,
    everyday,
    fields_of,
    floor,
    frame,
    look_at,
    plain,
    shifted,
    solve,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
MEASURED = float(decode_lut(None)[GREY, 0])  # radiance of every real surface that the camera sees
UP, DOWN = 5, 4  # slabs of the directional voxels (cone directions) that hold faces looking up, down
SIZE, EDGE_M = 64, 0.8
# A disc above a floor. 12 voxels high both lie in the middle of level 2's cells, so that coarse cells show them where
# they are. The form factor of the point below its middle is r^2 / (r^2 + h^2).
RADIUS, HEIGHT = 0.18, 0.15
FACTOR = RADIUS**2 / (RADIUS**2 + HEIGHT**2)
APART_M = 1e-4  # discs lie beside that middle, a border of voxels, or rounding would choose their voxels
MARCH_ERROR = 0.35  # of a single form factor seen from one height (test_furnace, whole shares: 0.9 to 1.35)
LEAST_CLOSED = 0.96  # what cones find of the light in a closed box: some leave past its edges


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def disc(radius: float, height: float, *, down: bool = False) -> trimesh.Trimesh:
    """One-sided; looks up, or down."""
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rim = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(48, height)], axis=1)
    faces = [[48, i, (i + 1) % 48] for i in range(48)]
    mesh = trimesh.Trimesh([*rim, (0, 0, height)], faces, process=False)
    if down:
        mesh.invert()
    return mesh


def settings(bounces: int) -> dict[str, float]:
    return {"volume_size": SIZE, "volume_edge_m": EDGE_M, "bounces": bounces}


def radiance_at(
    voxels: VoxelMipmap, origin: NDArray[np.float64], slab: int, spot_m: float, z: float
) -> float:
    """Mean radiance (green) of the faces at height `z` within `spot_m` of the z axis."""
    texels = np.frombuffer(voxels.texture.read(), np.float16).reshape(-1, SIZE, SIZE, 4)
    level = texels[slab * SIZE : (slab + 1) * SIZE].astype(float)
    centres = [o + (np.arange(SIZE) + 0.5) * EDGE_M / SIZE for o in origin]
    rows = np.abs(centres[2] - z) <= EDGE_M / SIZE
    near = np.hypot(centres[0][None, :], centres[1][:, None]) < spot_m
    found = level[rows][:, near]
    return float(found[..., 1].sum() / found[..., 3].sum())


def voxel_radiance(
    gpu: GpuContext, document: SceneDocument, slab: int, z: float, *, mu: bool = False, spot_m: float = 0.03
) -> float:
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(plain()))
    graph = renderer.graph
    assert graph is not None
    voxels = graph["bounces real" if mu else "bounces joint"]
    found = radiance_at(voxels, np.array(graph["volume"].placement.origin), slab, spot_m, z)
    renderer.release()
    return found


BURIED = cube(0.02, (0.0, 0.0, -0.2))


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1, 2, 4])
def test_glowing_box_is_a_geometric_series(gpu: GpuContext, stage: Stage, bounces: int) -> None:
    """Inside a closed box of glow L and albedo a the radiance is L (1 + a + a^2 + ...), a term a gather."""
    glow, albedo = 0.1, 0.6
    box = shifted(trimesh.creation.box((0.4, 0.36, 0.44)), 0.003, 0.002, 0.005)
    box.invert()
    material = {"emission": (glow,) * 3, "specular": 0}
    objects = [stage.virtual(box, (albedo,) * 3, material)]
    document = stage.document(objects, [], shifted(floor(), 0, 0, -1), **settings(bounces))
    inside = frame(plain(0), pose=look_at((0.05, -0.06, 0.02), (0.0, 0.15, 0.0)))
    found = solve(gpu, document, inside)
    series = [
        np.pi * glow * sum((albedo * kept) ** i for i in range(bounces + 1)) for kept in (LEAST_CLOSED, 1)
    ]
    irradiance = found.on_object[found.matte == 1].mean()
    print(f"{bounces} bounces in a box: {irradiance / series[1]:.3f} of the series")
    assert LEAST_CLOSED * series[0] <= irradiance <= 1.005 * series[1]


def test_object_takes_light_from_a_real_surface(gpu: GpuContext, stage: Stage) -> None:
    """No lights, black surroundings: a small plate above a real disc that the camera measured."""
    plate = disc(0.05, HEIGHT, down=True)
    real = disc(RADIUS, 0.0)
    dark = stage.document([stage.virtual(plate, (0.8,) * 3)], [], real, **settings(0))
    lit = stage.document([stage.virtual(plate, (0.8,) * 3)], [], real, **settings(1))
    found = voxel_radiance(gpu, lit, DOWN, HEIGHT)
    print(f"plate above a real disc: {found / (0.8 * MEASURED * FACTOR):.3f} of its form factor")
    assert voxel_radiance(gpu, dark, DOWN, HEIGHT) == 0
    assert found == pytest.approx(0.8 * MEASURED * FACTOR, rel=MARCH_ERROR)


@pytest.mark.parametrize("glow", [0.0, 1.5])
@pytest.mark.parametrize("receiver", ["virtual", "real"])
def test_disc_blocks_ambient_light_and_gives_its_own(
    gpu: GpuContext, stage: Stage, receiver: str, glow: float
) -> None:
    """Below a black disc of glow L under ambient light R: radiance a (R (1 - F) + L F). The real floor is one whose
    albedo is 0.5 by what the camera measured: its change is that of the ratio."""
    around = 2 * MEASURED
    shape = disc(RADIUS, HEIGHT + APART_M, down=True)
    above = stage.virtual(shape, (0.0,) * 3, {"emission": (glow,) * 3})
    if receiver == "virtual":
        objects, real = [above, stage.virtual(disc(0.25, -APART_M))], shifted(floor(), 0, 0, -1)
    else:
        objects, real = [above], shifted(floor(), 0, 0, -APART_M)
    document = stage.document(objects, [ambient(around)], real, **settings(1))
    found = voxel_radiance(gpu, document, UP, 0.0)
    expected = 0.5 * (around * (1 - FACTOR) + glow * FACTOR)
    print(f"{receiver} floor, glow {glow}: {found:.4f}, closed form {expected:.4f}")
    assert found == pytest.approx(expected, abs=0.12 * 0.5 * around)
    assert found < 0.7 * 0.5 * around if glow == 0 else found > 1.2 * 0.5 * around


def test_unseen_real_surfaces_gather_too(gpu: GpuContext, stage: Stage) -> None:
    """The underside of a real block above a measured disc has albedo 0.5 and the disc's light."""
    block = shifted(trimesh.creation.box((0.1, 0.1, 0.08)), 0, 0, HEIGHT + 0.04)
    real = disc(RADIUS, 0.0) + block
    for bounces, expected in ((0, 0.0), (1, 0.5 * MEASURED * FACTOR)):
        document = stage.document([stage.virtual(BURIED)], [], real, **settings(bounces))
        found = voxel_radiance(gpu, document, DOWN, HEIGHT, mu=True)
        print(f"unseen underside, {bounces} bounces: {found:.4f}, closed form {expected:.4f}")
        assert found == pytest.approx(expected, rel=MARCH_ERROR)


def test_gathered_light_follows_a_moving_object(gpu: GpuContext, stage: Stage) -> None:
    """What is kept from the pose before leaves no trace: the bytes are those of a fresh renderer."""
    here = everyday(stage, bounces=2)
    there = here.model_copy(update={"objects": [here.objects[0]]})
    renderer = SceneRenderer(gpu, here)
    for document in (here, there, here):
        renderer.set_scene(document)
        color = renderer.render(frame()).color
        found = fields_of(renderer)
    fresh = solve(gpu, here)
    assert np.array_equal(found.cones_rho, fresh.cones_rho)
    assert np.array_equal(found.on_object, fresh.on_object)
    assert color.any()
    renderer.release()


def light_taken(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> float:
    """Share of the light of cones on real surfaces that the objects take."""
    found = solve(gpu, document, view)
    real = (found.matte == 0) & (found.fade == 1)
    return float(1 - found.cones_rho[real].sum() / found.cones_mu[real].sum())


@contextmanager
def no_tail() -> Iterator[None]:
    """Light of the bounces that are gathered, alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BounceTail, "find", lambda *_, **_given: None)
        yield


FROM_THE_FRONT = look_at((0.0, -0.75, 0.03), (0.0, 0.3, 0.0))
FROM_THE_SIDE = look_at((0.28, -0.6, 0.28), (-0.15, 0.2, -0.15))


def in_a_niche(
    gpu: GpuContext, stage: Stage, bounces: int, pose: BoardPose = FROM_THE_FRONT, name: str = "dvct"
) -> float:
    """What a black cube takes in a niche; from the front, the camera sees all walls and measures their light."""
    niche = shifted(trimesh.creation.box((0.6, 0.56, 0.64)), 0.003, 0.002, 0.005)
    niche.invert()
    niche.update_faces(niche.face_normals[:, 1] < 0.5)  # open towards -y
    lamp, objects = sphere_light((0.05, -0.6, 0.2), 1.0), [stage.virtual(cube(0.16), (0.0,) * 3)]
    document = stage.document(objects, [lamp], niche, name=name, **settings(bounces))
    return light_taken(gpu, document, frame(plain(), pose=pose))


@pytest.mark.parametrize("bounces", [1, 2])
def test_the_tail_stands_for_further_gatherings(gpu: GpuContext, stage: Stage, bounces: int) -> None:
    found, many = in_a_niche(gpu, stage, bounces), in_a_niche(gpu, stage, 4)
    print(f"{bounces} bounces: {found:.4f} of the light is taken, with four {many:.4f}")
    assert found == pytest.approx(many, rel=0.035)


def test_without_the_tail_a_bounce_takes_much_less_than_four(gpu: GpuContext, stage: Stage) -> None:
    with no_tail():
        assert in_a_niche(gpu, stage, 1) < 0.85 * in_a_niche(gpu, stage, 4)


def test_two_solutions_take_what_the_change_does_where_the_camera_sees_a_part(
    gpu: GpuContext, stage: Stage
) -> None:
    """Walls out of sight have gathered light in both solutions, the first guess of a bounce among them."""
    change, solutions = (in_a_niche(gpu, stage, 1, FROM_THE_SIDE, name) for name in ("dvct", "differential"))
    print(f"{change:.4f} of the light is taken, by two solutions {solutions:.4f}")
    assert solutions == pytest.approx(change, rel=0.1)


def on_a_floor(gpu: GpuContext, stage: Stage) -> NDArray[np.float64]:
    objects, lights = [stage.virtual(cube(0.16), (0.7,) * 3)], [sphere_light((0.4, -0.3, 0.8)), ambient(0.2)]
    return solve(gpu, stage.document(objects, lights, floor(), **settings(1))).cones_rho


def test_a_floor_sends_itself_nothing_back(gpu: GpuContext, stage: Stage) -> None:
    """It has no tail: whatever the object changes, the bits are those without."""
    found = on_a_floor(gpu, stage)
    with no_tail():
        alone = on_a_floor(gpu, stage)
    assert np.array_equal(found, alone)
