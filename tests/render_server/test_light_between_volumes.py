"""Light that leaves one light propagation volume and arrives in another (docs/method.md 5.9)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.geometry_state import ObjectExtent
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.methods.volume_placement import outside_fractions
from deltalight.render_server.passes.volumes import VolumePlacement
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    Fields,
    Stage,
    ambient,
    array_of,
    ball,
    fields_of,
    floor,
    frame,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
RADIUS = 0.06
AMBIENT = 0.3  # radiance
GLOW = 20.0  # radiance
ABOVE = (1.0, 0.0, 0.6)  # middle of what glows; its own volume is far from the floor


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def lit_by(stage: Stage, mesh: trimesh.Trimesh, glow: float, **method: Any) -> SceneDocument:  # noqa: ANN401
    """A black ball on a floor, and far from it a `mesh` that glows and reflects nothing; no other light."""
    objects = [
        stage.virtual(ball(RADIUS, (0, 0, RADIUS)), (0, 0, 0)),
        stage.virtual(shifted(mesh, *ABOVE), (0, 0, 0), {"emission": (glow, glow / 2, 0.0)}),
    ]
    document = stage.document(objects, [ambient(AMBIENT)], floor())
    settings = {"name": "dlpv", "query_scale": 1, "rsm_size": 256, "bounces": 0, **method}
    return document.replaced(method=DlpvMethod.model_validate(settings))


@dataclass(frozen=True)
class Found:
    """One frame: fields, the change of irradiance at real surfaces, and the sources of the exchange, if any."""

    fields: Fields
    change: np.ndarray
    sources: np.ndarray | None


def found(gpu: GpuContext, document: SceneDocument) -> Found:
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    assert renderer.graph is not None
    fields, rows = fields_of(renderer), renderer.graph["exchange between volumes"]
    sources = None if rows is None else array_of(rows)
    renderer.release()
    return Found(fields, fields.cones_rho - fields.cones_mu, sources)


def floor_beside(fields: Fields) -> np.ndarray:
    """Pixels of the floor in the first ball's volume, where nothing fades."""
    near = np.abs(fields.position[..., :2]).max(axis=-1) < 2 * RADIUS - 0.02
    return np.asarray(near & (fields.matte == 0) & (fields.position[..., 3] > 0))


@pytest.mark.parametrize("operator", ["difference", "paper"])
def test_a_glowing_ball_lights_the_floor_in_another_volume_as_a_point_does(
    gpu: GpuContext, stage: Stage, operator: str
) -> None:
    """E = I cos / d^2 with I = pi L r^2. What the ball blocks of the light around it is sent, too."""
    bright = ball(RADIUS, (0, 0, 0))
    dark, glowing = (found(gpu, lit_by(stage, bright, glow, operator=operator)) for glow in (0, GLOW))
    seen = floor_beside(dark.fields)
    gained = (glowing.change - dark.change)[seen]
    away = np.asarray(ABOVE) - dark.fields.position[seen][:, :3]
    wanted = np.pi * GLOW * RADIUS**2 * away[:, 2] / np.linalg.norm(away, axis=-1) ** 3
    assert seen.sum() > 200
    assert gained[:, 0] == pytest.approx(wanted, rel=0.03)
    assert gained[:, 1] == pytest.approx(wanted / 2, rel=0.03)
    assert np.abs(gained[:, 2]).max() < 1e-3
    assert dark.sources is not None
    if operator == "difference":  # the other one's ambient light is not blocked
        lost = dark.sources[1, 4]
        assert lost[3] == pytest.approx(-np.pi * AMBIENT * bright.area, rel=0.01)
        assert np.linalg.norm(lost[:3]) < 0.02 * -lost[3]


def test_a_glowing_plate_sends_its_light_forwards(gpu: GpuContext, stage: Stage) -> None:
    """E = L A cos cos' / d^2, on the floor; nothing to its back."""
    edge = 0.06
    square = trimesh.Trimesh(
        np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * edge / 2, [[0, 2, 1], [0, 3, 2]]
    )
    turn = trimesh.geometry.align_vectors((0, 0, -1), -np.asarray(ABOVE))
    down, up = (square.copy().apply_transform(each) for each in (turn, -turn))
    dark, lit, behind = (
        found(gpu, lit_by(stage, mesh, glow)) for mesh, glow in ((down, 0.0), (down, GLOW), (up, GLOW))
    )
    seen = floor_beside(dark.fields)
    away = np.asarray(ABOVE) - dark.fields.position[seen][:, :3]
    apart = np.linalg.norm(away, axis=-1)
    towards = away @ np.asarray(ABOVE) / np.linalg.norm(ABOVE) / apart
    gained = (lit.change - dark.change)[seen][:, 0]
    assert gained == pytest.approx(GLOW * edge**2 * towards * away[:, 2] / apart**3, rel=0.03)
    assert np.abs((behind.change - dark.change)[seen]).max() < 1e-3


def test_light_from_inside_of_a_closed_body_does_not_leave_it(gpu: GpuContext, stage: Stage) -> None:
    """The inner side of a ball that glows on both adds less than a fifth (cells are coarse), in place of all."""
    outer = ball(RADIUS, (0, 0, 0))
    inner = trimesh.Trimesh(0.999 * outer.vertices, outer.faces[:, ::-1], process=False)
    both = found(gpu, lit_by(stage, trimesh.util.concatenate([outer, inner]), GLOW)).sources
    assert both is not None
    assert 1.0 < both[1, 0, 3] / (np.pi * GLOW * outer.area) < 1.2


def test_a_single_volume_sends_its_light_nowhere(gpu: GpuContext, stage: Stage) -> None:
    assert found(gpu, lit_by(stage, ball(), 0.0, volume_edge_m=4.0)).sources is None


def test_what_is_inside_of_a_volume_is_not_sent_to_it_as_well() -> None:
    """Volumes of objects that are nearly joined hold parts of each other's objects."""

    def at(x: float) -> ObjectExtent:
        corners = np.array([[x - 0.5, -0.5, -0.5], [x + 0.5, 0.5, 0.5]])
        return ObjectExtent(corners, corners)

    cubes = tuple(VolumePlacement((x - 1.5, -1.5, -1.5), 3 / 32, 32) for x in (0.0, 1.75))
    outside = outside_fractions([at(0.0), at(1.75)], cubes)
    assert outside == pytest.approx(np.array([[0, 0.75], [0.75, 0]]))
    assert outside_fractions([at(0.0)], cubes) == pytest.approx(np.array([[0, 0.75], [0, 0]]))
