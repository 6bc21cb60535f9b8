"""How far lights are, by the falloff of light over paper, and by several cues together."""

from dataclasses import replace

import numpy as np
import pytest

from deltalight.protocol.octahedral import octahedral_grid, texel_solid_angles
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import SkyLights, TrackedLight
from deltalight.render_server.lights.light_distance import CANDIDATES, DistanceCue, common_inverse
from deltalight.render_server.lights.paper_distance import PaperLight, paper_cue

TO_LAMP = np.array([0.8, -0.2, 0.55]) / np.linalg.norm([0.8, -0.2, 0.55])
LAMP, WALL = 1.5, 0.8
FISHEYE = np.array([0.1, 0.17, 0.05])
SIZE = 64


def sky() -> SkyLights:
    """A lamp, and half of all directions shows a wall that the lamp lights."""
    towards = octahedral_grid(SIZE)
    wall = WALL * np.maximum(towards @ TO_LAMP, 0.05)
    residual = np.repeat(wall[..., None], 3, axis=-1).astype(np.float32)
    fisheye = np.eye(4)
    fisheye[:3, 3] = FISHEYE
    light = TrackedLight(0, TO_LAMP, np.full(3, LAMP), 0.05)
    return SkyLights(LightCut(), fisheye, (light,), (), residual, np.ones((SIZE, SIZE, 1), np.float32))


def paper(distance_m: float, noise: float = 0.02) -> PaperLight:
    """A sheet of 18 x 14 cm beside the fish-eye camera; lamp and walls are as far away as told."""
    across, up = np.meshgrid(np.linspace(0, 0.18, 30), np.linspace(-0.14, 0, 24))
    points = np.stack([across.ravel(), up.ravel(), np.zeros(across.size)], axis=1)
    given = sky()
    towards = octahedral_grid(SIZE).reshape(-1, 3)
    to_wall = FISHEYE + distance_m * towards - points[:, None]
    length = np.linalg.norm(to_wall, axis=-1)
    form = np.maximum(to_wall[..., 2], 0) * np.einsum("kti,ti->kt", to_wall, towards) / length**4
    area = distance_m**2 * texel_solid_angles(SIZE).ravel()
    walls = form * area @ given.residual.reshape(-1, 3)[:, 0]
    to_lamp = FISHEYE + distance_m * TO_LAMP - points
    lamp = LAMP * distance_m**2 * to_lamp[:, 2] / np.linalg.norm(to_lamp, axis=1) ** 3
    light = np.repeat((walls + lamp)[:, None], 3, axis=1)
    light *= np.random.default_rng(7).normal(1, noise, light.shape)
    tile = (across // 0.045).astype(int) + 10 * (up // 0.045).astype(int) + 100
    return PaperLight(points, light, tile.ravel())


@pytest.mark.parametrize("distance_m", [0.8, 1.2])
def test_walls_as_far_as_the_lamp_do_not_make_it_seem_nearer(distance_m: float) -> None:
    cue = paper_cue(paper(distance_m), sky())
    assert cue is not None
    assert cue.tells_near
    assert 1 / common_inverse([cue]) == pytest.approx(distance_m, rel=0.06)


@pytest.mark.parametrize("size", [4, 8])
def test_maps_of_a_few_texels_tell_the_distance_roughly(size: int) -> None:
    whole = sky()
    texels = whole.residual.reshape(size, SIZE // size, size, SIZE // size, 3).mean(axis=(1, 3))
    cue = paper_cue(paper(1.0), replace(whole, residual=texels))
    assert cue is not None
    assert 1 / common_inverse([cue]) == pytest.approx(1.0, rel=0.15)


def test_the_standard_error_of_the_paper_grows_with_its_noise() -> None:
    little, much = (paper_cue(paper(1.0, noise), sky()) for noise in (0.01, 0.05))
    assert little is not None
    assert much is not None
    assert much.estimate[1] > 2 * little.estimate[1]
    assert abs(much.estimate[0] - 1) < 3 * much.estimate[1]


def test_a_shadow_on_the_paper_changes_little() -> None:
    whole = paper(1.0)
    shadowed = (whole.points[:, 0] > 0.15) & (whole.points[:, 1] > -0.04)
    partly = replace(whole, irradiance=np.where(shadowed[:, None], 0.6, 1) * whole.irradiance)
    cue = paper_cue(partly, sky())
    assert cue is not None
    assert common_inverse([cue]) == pytest.approx(1.0, rel=0.1)


def cue(inverse: float, error: float, tiles: int = 40) -> DistanceCue:
    """Tiles that say the inverse distance with some scatter, each in its own words."""
    draws = np.random.default_rng(3).normal(0, 1, tiles)
    said = inverse + error * np.sqrt(tiles) * (draws - draws.mean()) / draws.std(ddof=1)
    return DistanceCue(CANDIDATES, (np.array(CANDIDATES)[:, None] - said) ** 2)


def test_a_cue_knows_its_standard_error() -> None:
    assert cue(1.0, 0.1).estimate == pytest.approx((1.0, 0.1))


def test_cues_count_by_how_sure_they_are() -> None:
    assert common_inverse([cue(1.0, 0.1), cue(1.4, 0.1)]) == pytest.approx(1.2)
    assert common_inverse([cue(1.0, 0.3), cue(1.4, 0.1)]) == pytest.approx(1.36)


def test_what_tiles_disagree_about_tells_nothing() -> None:
    assert cue(1.0, 0.1).tells_near
    assert not cue(0.4, 0.5).tells_near
