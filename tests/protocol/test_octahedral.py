"""The octahedral mapping of the sphere."""

import numpy as np
import pytest

from deltalight.protocol.octahedral import (
    octahedral_direction,
    octahedral_grid,
    octahedral_uv,
    resize_octahedral,
    sample_octahedral,
    texel_solid_angles,
)


def random_directions(count: int) -> np.ndarray:
    vectors = np.random.default_rng(1).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_octahedral_mapping_is_its_own_inverse_and_upright() -> None:
    directions = random_directions(1000)
    assert octahedral_direction(octahedral_uv(directions)) == pytest.approx(directions, abs=1e-12)
    assert octahedral_uv(np.array([0.0, 0, 1])) == pytest.approx([0.5, 0.5])
    assert octahedral_uv(np.array([1.0, 0, 0])) == pytest.approx([1, 0.5])
    assert octahedral_uv(np.array([0.0, 1, 0])) == pytest.approx([0.5, 1])
    corner = octahedral_uv(np.array([0.0, 0, -1.0]))
    assert np.abs(corner - 0.5) == pytest.approx([0.5, 0.5])


def test_texel_solid_angles_cover_the_sphere_and_follow_the_mapping() -> None:
    weights = texel_solid_angles(32)
    assert weights.sum() == pytest.approx(4 * np.pi, rel=1e-5)
    samples = random_directions(400_000)
    texel = np.minimum((octahedral_uv(samples) * 4).astype(int), 3)
    share = np.bincount(texel[:, 1] * 4 + texel[:, 0], minlength=16).reshape(4, 4) / len(samples)
    assert texel_solid_angles(4) / (4 * np.pi) == pytest.approx(share, rel=0.02)


@pytest.mark.parametrize("size", [4, 16, 32])
def test_a_map_of_another_size_shows_the_same_directions(size: int) -> None:
    """Radiance that is linear in the direction; bilinear between texels of 10 degrees."""
    wide = octahedral_grid(16).astype(np.float32) + 1
    found = resize_octahedral(wide, size)
    assert found == pytest.approx(octahedral_grid(size) + 1, abs=0.05)
    assert np.array_equal(found, sample_octahedral(wide, octahedral_grid(size)))
