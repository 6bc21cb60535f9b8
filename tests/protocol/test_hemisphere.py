"""The hemisphere's grid: directions, map coordinates and solid angles."""

import numpy as np
import pytest

from deltalight.protocol.hemisphere import (
    hemisphere_direction,
    hemisphere_uv,
    texel_directions,
    texel_solid_angles,
)


def test_the_axis_is_the_centre_and_the_horizon_the_border() -> None:
    assert hemisphere_direction(np.array([0.5, 0.5])) == pytest.approx([0, 0, 1])
    border = np.array([[0, 0.3], [1, 0.8], [0.25, 0], [0.6, 1]])
    assert hemisphere_direction(border)[:, 2] == pytest.approx(0, abs=1e-12)


def test_coordinates_and_directions_are_inverse() -> None:
    uv = np.random.default_rng(1).random((500, 2))
    directions = hemisphere_direction(uv)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1)
    assert (directions[:, 2] >= 0).all()
    assert hemisphere_uv(7.0 * directions) == pytest.approx(uv, abs=1e-12)


@pytest.mark.parametrize("size", [1, 8, 48, 600])
def test_solid_angles_integrate_the_hemisphere(size: int) -> None:
    solid, directions = texel_solid_angles(size).astype(np.float64), texel_directions(size).astype(np.float64)
    assert solid.sum() == pytest.approx(2 * np.pi, rel=1e-5)
    # The irradiance of an even sky of radiance 1 is pi; a coarse grid only roughly.
    assert (solid * directions[..., 2]).sum() == pytest.approx(np.pi, rel=2 / size**2 + 1e-4)


def test_the_solid_angle_of_a_texel_is_that_of_its_corners() -> None:
    size, row, column = 16, 3, 11
    corners = np.array([[column, row], [column + 1, row], [column + 1, row + 1], [column, row + 1]]) / size
    a, b, c, d = hemisphere_direction(corners)

    def triangle(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> float:
        return float(2 * np.arctan2(abs(p @ np.cross(q, r)), 1 + p @ q + q @ r + r @ p))

    assert texel_solid_angles(size)[row, column] == pytest.approx(
        triangle(a, b, c) + triangle(a, c, d), rel=1e-3
    )
    assert texel_directions(size)[row, column] == pytest.approx(
        hemisphere_direction(np.array([(column + 0.5) / size, (row + 0.5) / size])), abs=1e-6
    )


def test_tables_are_shared_and_read_only() -> None:
    assert texel_directions(8) is texel_directions(8)
    with pytest.raises(ValueError, match="read-only"):
        texel_solid_angles(8)[0, 0] = 1
