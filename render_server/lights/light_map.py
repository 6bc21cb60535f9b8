"""All light around a point as one octahedral map, and its irradiance in nine harmonics (docs/method.md 6.6)."""

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.octahedral import octahedral_grid, sample_octahedral, texel_solid_angles
from deltalight.render_server.lights.light_models import Light, incident_light
from deltalight.render_server.lights.lights import ENVIRONMENT_SIZE, LightSet
from deltalight.render_server.lights.octahedral import harmonics

ORDER = 3
# Of the clamped cosine, by band (Ramamoorthi & Hanrahan 2001, eq. 8).
COSINE_BANDS = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])


def light_map(lights: LightSet, position: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "n n 3"]:
    """Returns the radiance that arrives at a position (world, m) from everywhere, without anything in between.

    That is the map that the lights were cut out of, or else the environment with the lights put back as discs of
    their irradiance, at least two texels wide.
    """
    if lights.whole is not None:
        return lights.whole
    if not lights.lights:
        return lights.environment
    directions = octahedral_grid(max(len(lights.environment), ENVIRONMENT_SIZE))
    radiance = sample_octahedral(lights.environment, directions)
    for light in lights.lights:
        radiance += _disc(light, position, directions)
    return radiance


def _disc(
    light: Light, position: Float64[np.ndarray, "3"], directions: Float64[np.ndarray, "n n 3"]
) -> Float32[np.ndarray, "n n 3"]:
    arriving = incident_light(light, position)
    solid_angles = texel_solid_angles(len(directions))
    cosine = directions @ arriving.to_light
    texel = np.sqrt(4 * np.pi) / len(directions)
    radius = max(float(arriving.angular_radius_rad), texel)
    coverage = np.clip((radius - np.arccos(np.clip(cosine, -1, 1))) / texel + 0.5, 0, 1)
    across = np.sum(coverage * solid_angles * np.maximum(cosine, 0))
    return np.asarray((coverage / across)[..., None] * arriving.irradiance, np.float32)


def coefficients_around(
    lights: LightSet, residual: Float64[np.ndarray, "k 3"], position: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "k 3"]:
    """Returns the harmonics of all light that arrives at a position, as `light_map` has it, lights being points.

    `residual`: those of the light that is the same everywhere (`distant_coefficients`).
    """
    if lights.whole is not None or not lights.lights:
        return residual
    arriving = [incident_light(light, position) for light in lights.lights]
    basis = harmonics(np.stack([each.to_light for each in arriving]), round(len(residual) ** 0.5))
    return np.asarray(residual + basis.T @ np.stack([each.irradiance for each in arriving]))


def distant_coefficients(lights: LightSet, order: int) -> Float64[np.ndarray, "k 3"]:
    """Returns the harmonics of the map that the lights were cut out of, or else of what is left without them."""
    return light_coefficients(lights.environment if lights.whole is None else lights.whole, order)


def irradiance_coefficients(radiance: Float32[np.ndarray, "n n 3"]) -> Float64[np.ndarray, "9 3"]:
    """Returns the nine coefficients c of E(n) = sum c_k Y_k(n) (Ramamoorthi & Hanrahan 2001)."""
    return np.asarray(COSINE_BANDS[:, None] * light_coefficients(radiance, ORDER))


def light_coefficients(radiance: Float32[np.ndarray, "n n 3"], order: int) -> Float64[np.ndarray, "k 3"]:
    """Projects a map onto the harmonics of `order` bands: the integrals of radiance times each."""
    size = len(radiance)
    basis = harmonics(octahedral_grid(size).reshape(-1, 3), order)
    weighted = radiance.reshape(-1, 3) * texel_solid_angles(size).reshape(-1, 1)
    return np.asarray(basis.T @ weighted)
