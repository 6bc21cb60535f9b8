"""Radiance maps from the pictures of a fish-eye camera, and warnings about them."""

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.frames import FisheyePictures, RadianceMap
from deltalight.protocol.hemisphere import texel_directions, texel_solid_angles
from deltalight.sensor_node.fisheye.exposures import display_picture, merge_bracket, reference_exposure
from deltalight.sensor_node.fisheye.resampling import hemisphere_sampler

SIZE = 256
LEAST_CLIPPED_FRACTION = 1e-5
"""The sun's disc (6.8e-5 sr) relative to the hemisphere: the smallest thing that lights a room."""
LEAST_COSINE_FRACTION = 0.95
"""Of an even sky's irradiance; beyond, more than the 5 % within which light is measured here is lost."""


def radiance_map(
    pictures: FisheyePictures,
    world_from_fisheye: Float64[np.ndarray, "4 4"],
    size: int = SIZE,
    reference_s: float | None = None,
) -> RadianceMap:
    """Merges a bracket and resamples it to the hemisphere about the lens's axis.

    Args:
        pictures: the camera's pictures of one moment.
        world_from_fisheye: pose of its optical frame, (4, 4), metres.
        size: texels per edge of the map.
        reference_s: exposure in which white is 1.0, s; None = the longest of this bracket. Pass the same for all
            pictures of a camera, so that the map's units stay.

    Raises:
        DeltalightError: the pictures do not fit each other or the calibration.
    """
    reference = reference_exposure(pictures.exposures_s) if reference_s is None else reference_s
    merged = merge_bracket(pictures, reference)
    sampler = hemisphere_sampler(pictures.calibration, size)
    radiance, clipped_share = sampler.resample(merged)
    return RadianceMap(
        timestamp_ns=pictures.timestamp_ns,
        radiance=radiance,
        seen=sampler.seen,
        world_from_fisheye=world_from_fisheye,
        clipped_share=clipped_share,
        picture=display_picture(pictures.pictures, merged, sampler.inside > 0),
        calibration=pictures.calibration,
    )


def light_warnings(radiance: RadianceMap) -> list[str]:
    """Returns a sentence for each thing that makes the light of a map wrong, and what to do."""
    sentences = []
    if radiance.clipped_share >= LEAST_CLIPPED_FRACTION:
        sentences.append(
            f"the fish-eye picture is overexposed: {100 * radiance.clipped_share:.2g} % of what it sees is clipped "
            "even at the shortest exposure, so its light is too weak; add a shorter exposure."
        )
    size = len(radiance.seen)
    solid, cosine = texel_solid_angles(size), texel_directions(size)[..., 2]
    if float((solid * cosine)[radiance.seen].sum()) < LEAST_COSINE_FRACTION * np.pi:
        fraction = float(solid[radiance.seen].sum()) / (2 * np.pi)
        sentences.append(
            f"the fish-eye lens sees {100 * fraction:.0f} % of the hemisphere about its axis; light from the rest is "
            "estimated, so use a lens of 160 degrees or more, or correct `image_circle` in fisheye.yaml."
        )
    return sentences
