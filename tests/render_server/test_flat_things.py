"""Sheets that nobody declared on mirroring planes: told by the reflection that the picture lacks there."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.ground_truth.textures import wood
from deltalight.protocol.scene_objects import Surface
from deltalight.render_server.estimation.flat_things import FlatThing, FlatThings, find_sheets, mirror_planes
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.scene.declared_surfaces import build_surface_table
from deltalight.render_server.scene.plane_reflection import plane_reflection
from deltalight.render_server.view import PosedFrame
from tests.render_server.mirroring_table import SILVER, VARNISH, Sheet, lens, seen
from tests.render_server.scenes import COARSE, Stage, ambient, ball
from tests.render_server.test_things_on_smooth_surfaces import mirrored

pytestmark = pytest.mark.usefixtures("clean_gl")
SECOND_NS = 1_000_000_000


def found(taken: PosedFrame, surface: Surface = SILVER) -> list[FlatThing]:
    declared = build_surface_table([surface])
    (plane,) = mirror_planes(declared)
    return find_sheets(taken, plane, declared)


def test_the_prediction_is_the_mirror_image() -> None:
    """Where the picture shows what is mirrored, off its edges by more than depth errs."""
    (plane,) = mirror_planes(build_surface_table([SILVER]))
    reflection = plane_reflection(seen(), plane)
    assert reflection is not None
    compared = reflection.on_plane & reflection.known
    assert compared.mean() > 0.1
    off = np.abs(reflection.expected - reflection.picture).max(axis=2)[compared]
    assert np.median(off) < 0.01
    assert np.percentile(off, 85) < 0.05


@pytest.mark.parametrize("radiance", [(0.75, 0.72, 0.68), (0.03, 0.03, 0.03), (0.2, 0.3, 0.4)])
def test_a_sheet_that_mirrors_nothing_is_found(radiance: tuple[float, float, float]) -> None:
    sheet = Sheet(radiance)
    (thing,) = found(seen(sheet=sheet))
    nearest = np.linalg.norm(thing.outline[:, None] - sheet.corners, axis=2).min(axis=0)
    assert nearest.max() < 0.012
    np.testing.assert_allclose(thing.colour, radiance, atol=0.01)


def test_a_mirror_is_none() -> None:
    assert not found(seen())


@pytest.mark.parametrize("roughness", [0.02, 0.2])
def test_wood_under_varnish_and_shadows_are_none(roughness: float) -> None:
    """Its grain is stronger than the reflection, and a shadow with sharp edges hides a half of it."""
    grain = cv2.resize(0.3 * wood(11, 480, 640, planks=5), (640, 480)).astype(np.float64)
    grain[200:, :300] *= 0.3
    varnish = VARNISH.replaced(roughness=roughness)
    assert not found(seen(varnish, diffuse=grain), varnish)


def test_where_nothing_varies_nothing_is_concluded() -> None:
    """The wall alone, of one colour: a sheet may be a mirror that shows it."""
    assert not found(seen(sheet=Sheet(), has_carton=False))


def test_a_declared_sheet_is_not_found_again() -> None:
    sheet = Sheet()
    region = {"sheet": {"middle_m": sheet.middle, "size_m": sheet.size, "turn_deg": sheet.turn_deg}}
    declared = build_surface_table([Surface.model_validate({"region": region}), SILVER])
    np.testing.assert_allclose(declared.sheets[0], sheet.corners, atol=1e-6)
    (plane,) = mirror_planes(declared)
    assert not find_sheets(seen(sheet=sheet), plane, declared)


def test_sheets_stay_until_something_else_is_there() -> None:
    """The search is due after 1, 2, 4 ... s: in between, and while the sheet cannot be told, it stays."""
    things, declared = FlatThings(), build_surface_table([SILVER])

    def at(second: float, **of: object) -> int:
        return len(things.update(seen(timestamp_ns=int(second * SECOND_NS), **of), declared))  # type: ignore[arg-type]

    assert at(0.0, sheet=Sheet()) == 1
    assert at(0.5) == 1
    assert at(1.5, sheet=Sheet(), has_carton=False) == 1
    assert at(4.0) == 0
    assert at(9.0, sheet=Sheet()) == 1


def test_objects_are_not_mirrored_in_a_found_sheet(gpu: GpuContext, tmp_path: Path) -> None:
    stage, sheet = Stage(tmp_path, COARSE), Sheet()
    glowing = stage.virtual(ball(0.03, (0.0, 0.08, 0.08)), (0, 0, 0), {"emission": [0.6] * 3})
    plain = stage.document([glowing], [ambient(0.2)])
    document = plain.replaced(real=plain.real.replaced(surfaces=(SILVER,)))
    bare, covered = (mirrored(gpu, document, seen(sheet=each).frame) for each in (None, sheet))
    local = (sheet.corners - seen().view.position) @ seen().view.world_from_camera[:3, :3]
    mask = np.zeros(bare.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(lens().project(local)).astype(np.int32), 1)
    within, around = cv2.erode(mask, np.ones((7, 7))) > 0, cv2.dilate(mask, np.ones((9, 9))) == 0
    assert (bare[within] > 0.5).sum() > 100
    assert not covered[within].any()
    assert np.mean(np.abs(covered - bare)[around] < 0.05) > 0.99
