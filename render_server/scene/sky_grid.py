"""The pixels of a map of radiance: where each looks and how much of the sky it holds."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True, eq=False)
class SkyGrid:
    """Unit direction (map axes) and solid angle (sr) of every pixel of a map."""

    directions: Float32[np.ndarray, "h w 3"]
    solid_angles: Float32[np.ndarray, "h w"]

    @cached_property
    def moments(self) -> Float32[np.ndarray, "h w 4"]:
        """Solid angle, and solid angle times direction."""
        parts = [np.ones_like(self.solid_angles)[..., None], self.directions]
        return np.asarray(np.concatenate(parts, axis=-1) * self.solid_angles[..., None])
