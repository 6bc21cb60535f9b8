"""The walking figure that the project ships: small, made here, and its feet walk on the ground."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.benchmarks import walking_figure
from deltalight.protocol.scene import load_scene
from deltalight.render_server.scene.gltf_meshes import GltfAsset, load_gltf

ASSETS = Path(__file__).parents[2] / "services" / "demo_assets"
MAX_BYTES = 200_000


@pytest.fixture(scope="module")
def figure() -> GltfAsset:
    return load_gltf(ASSETS / "figure.glb")


def test_the_shipped_figure_is_the_one_that_is_made_here(tmp_path: Path, figure: GltfAsset) -> None:
    made = load_gltf(walking_figure.build().write(tmp_path / "figure.glb"))
    assert (ASSETS / "figure.glb").stat().st_size < MAX_BYTES
    assert [(clip.name, clip.duration_s) for clip in figure.clips] == [("round", 3.0), ("walk", 1.0)]
    for ours, theirs in zip(made.clips, figure.clips, strict=True):
        for time_s in (0.0, 0.4):
            pairs = (
                asset.meshes(asset.pose(clip, time_s)) for asset, clip in ((made, ours), (figure, theirs))
            )
            for one, other in zip(*pairs, strict=True):
                assert np.array_equal(one.triangles, other.triangles)
                assert np.allclose(one.positions, other.positions, atol=1e-5)
                assert one.material.base_color == pytest.approx(other.material.base_color)


@pytest.mark.parametrize("clip", [0, 1])
def test_it_stands_on_the_ground_at_all_times(figure: GltfAsset, clip: int) -> None:
    playing = figure.clips[clip]
    for time_s in np.linspace(0, playing.duration_s, 50):
        bounds = np.stack([mesh.bounds() for mesh in figure.meshes(figure.pose(playing, float(time_s)))])
        assert -0.0005 < bounds[:, 0, 1].min() < 0.0015
        assert 0.16 < bounds[:, 1, 1].max() < 0.19


def test_it_goes_round_once_and_ends_where_it_began(figure: GltfAsset) -> None:
    clip = figure.clips[0]
    centres = []
    for time_s in np.linspace(0, clip.duration_s, 13):
        meshes = figure.meshes(figure.pose(clip, float(time_s)))
        centres.append(np.concatenate([mesh.positions for mesh in meshes]).mean(axis=0)[[0, 2]])
    angles = np.unwrap(np.arctan2(*np.transpose(centres)))
    assert angles[-1] - angles[0] == pytest.approx(2 * np.pi, abs=1e-3)
    assert np.linalg.norm(centres, axis=1) == pytest.approx(np.full(13, walking_figure.RADIUS_M), abs=0.005)
    assert centres[0] == pytest.approx(centres[-1], abs=1e-6)


def test_its_skin_is_closed_and_hangs_together(figure: GltfAsset) -> None:
    """No triangle is torn: edges stay shorter than 6 mm more than at rest while limbs bend."""
    rest = figure.meshes(figure.pose(None, 0.0))
    for time_s in (0.1, 0.35, 0.8):
        for still, moved in zip(rest, figure.meshes(figure.pose(figure.clips[1], time_s)), strict=True):
            lengths = [
                np.linalg.norm(np.diff(mesh.positions[mesh.triangles], axis=1), axis=2).max()
                for mesh in (still, moved)
            ]
            assert lengths[1] < lengths[0] + 0.006


def test_the_shipped_scene_is_valid_and_plays_the_figure() -> None:
    scene = load_scene(ASSETS / "figure.json")
    (item,) = scene.objects
    assert Path(item.asset) == ASSETS / "figure.glb"
    assert item.playing is not None
    assert item.playing.clip == "round"
