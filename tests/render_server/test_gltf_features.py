"""Features of glTF files look as the same by plain means, on the plates of the picture in docs/materials.md."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deltalight.benchmarks.gltf_features import FEATURES, LAMPS, Feature, written
from deltalight.benchmarks.gltf_plate import Plate
from tests.render_server.gltf_plates import seen_from_above
from tests.render_server.scenes import FOCAL, HEIGHT, ObjectsRenderer, Stage, directional, unlit

pytestmark = pytest.mark.usefixtures("clean_gl")
EDGE = 0.9 * HEIGHT / FOCAL  # m
((WAY, STRENGTH, RADIUS_DEG),) = LAMPS


def white(plate: Plate) -> None:
    plate.material["pbrMetallicRoughness"] = {"metallicFactor": 0}


@pytest.mark.parametrize("feature", FEATURES, ids=lambda feature: feature.sample)
def test_a_feature_looks_as_by_plain_means(
    objects: ObjectsRenderer, tmp_path: Path, feature: Feature
) -> None:
    def drawn(name: str, apply: Callable[[Plate], None]) -> np.ndarray:
        asset = {"asset": str(written(tmp_path / f"{name}.glb", apply, EDGE)), "up_axis": "z"}
        document = unlit(Stage(tmp_path).document([asset], [directional(WAY, STRENGTH, RADIUS_DEG)]))
        return objects.draw(document, seen_from_above()).color.astype(int)

    shown, expected, plain = (
        drawn(name, apply)
        for name, apply in (("feature", feature.feature), ("plain", feature.plain), ("white", white))
    )
    assert np.abs(shown - expected).max() <= 1
    assert np.abs(expected - plain).max() > 30, "the look is one that a white plate does not have"
