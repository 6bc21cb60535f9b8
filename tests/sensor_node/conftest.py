"""Small helpers of the sensor node's tests."""

import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.sensor_node.cameras.synthetic import SyntheticCamera


def pose_difference(
    first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"]
) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3])), float(
        np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    )


@pytest.fixture(scope="session")
def synthetic() -> SyntheticCamera:
    """Synthetic camera without noise."""
    return SyntheticCamera()
