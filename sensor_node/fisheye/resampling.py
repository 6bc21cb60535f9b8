"""Resampling of fish-eye pictures to hemi-octahedral maps without loss of energy, by precomputed tables."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from deltalight.protocol.fisheye_lens import FisheyeCalibration, FisheyeLens
from deltalight.protocol.hemisphere import hemisphere_direction, texel_solid_angles
from deltalight.sensor_node.fisheye.exposures import LinearPicture


@dataclass(frozen=True, eq=False)
class HemisphereSampler:
    """Resamples pictures of one calibration onto a map of `size` x `size` texels.

    The picture is averaged over squares of `shrink` pixels ("cells", about a texel wide), multiplied by `gain`, and
    sampled bilinearly at `per_texel`^2 positions of each texel, whose mean is the texel's value. Samples do not hit
    all cells equally often, so `gain` holds, besides 1/vignetting, each cell's solid angle over the solid angle that
    the map gives it: this preserves the flux of a lamp at any position, however small it is. Texels are `seen` if the
    lens sees more than half of them; `scale` makes their values means of what it sees, 0 elsewhere.
    """

    size: int
    shrink: int
    per_texel: int
    inside: UInt8[np.ndarray, "h w"]
    gain: Float32[np.ndarray, "cells_y cells_x"]
    weight: Float32[np.ndarray, "cells_y cells_x"]
    places: Float32[np.ndarray, "samples samples 2"]
    seen: Bool[np.ndarray, "size size"]
    scale: Float32[np.ndarray, "size size 1"]

    def resample(self, picture: LinearPicture) -> tuple[Float32[np.ndarray, "size size 3"], float]:
        """Returns the radiance map, 0 where nothing is seen, and the clipped fraction of the seen solid angle."""
        cells = _shrunk(cv2.copyTo(picture.linear, self.inside), self.shrink)
        samples = cv2.remap(
            cells * self.gain[..., None], self.places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        texels = _shrunk(samples, self.per_texel)
        texels *= self.scale
        clipped = _shrunk((picture.clipped & (self.inside > 0)).astype(np.float32), self.shrink)
        clipped_fraction = float((clipped * self.weight).sum() / max(float(self.weight.sum()), 1e-12))
        return texels, min(clipped_fraction, 1.0)


@lru_cache(maxsize=4)
def hemisphere_sampler(calibration: FisheyeCalibration, size: int) -> HemisphereSampler:
    """Creates the tables for a calibration (compared by value) and a map's size."""
    lens = calibration.lens
    pixel = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1)
    inside = lens.has_ray(pixel.reshape(-1, 2).astype(np.float64)).reshape(lens.height, lens.width)
    ratio = np.sqrt(2 * np.pi) / size / _pixel_angle(lens)
    shrink = max(1, round(ratio))
    # Half a cell apart, samples hit all cells nearly equally, so that an even sky stays even.
    per_texel = int(np.ceil(2 * ratio / shrink))
    inside_fraction = _shrunk(inside.astype(np.float32), shrink)
    places = _places(lens, size * per_texel, shrink)
    coverage = _shrunk(cv2.remap(inside_fraction, places, None, cv2.INTER_LINEAR), per_texel)
    seen = coverage > 0.5
    scale = np.where(seen, 1 / np.maximum(coverage, 0.5), 0)
    angle, solid, up = _cells(lens, inside_fraction.shape, shrink)
    gain = _flux_gain(places, size, inside_fraction, solid) / calibration.transmission(angle)
    weight = np.where(up, solid * inside_fraction, 0)
    return HemisphereSampler(
        size=size,
        shrink=shrink,
        per_texel=per_texel,
        inside=inside.astype(np.uint8),
        gain=gain.astype(np.float32),
        weight=weight.astype(np.float32),
        places=places,
        seen=seen,
        scale=scale.astype(np.float32)[..., None],
    )


def _pixel_angle(lens: FisheyeLens) -> float:
    """Returns the angle that a pixel spans on the axis, radians."""
    centre = np.clip(lens.centre, 1, [lens.width - 2, lens.height - 2])
    rays = lens.directions(centre + np.array([[-0.5, 0.0], [0.5, 0.0]]))
    return float(np.linalg.norm(rays[1] - rays[0]))


def _shrunk(picture: Float32[np.ndarray, "h w *c"], factor: int) -> Float32[np.ndarray, "cells_y cells_x *c"]:
    """Returns the mean over squares of pixels; the picture is padded with zeros to whole squares."""
    if factor == 1:
        return picture
    height, width = picture.shape[:2]
    below, right = -height % factor, -width % factor
    if below or right:
        picture = cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_CONSTANT, value=0)
    size = (width + right) // factor, (height + below) // factor
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _places(lens: FisheyeLens, edge: int, shrink: int) -> Float32[np.ndarray, "edge edge 2"]:
    """Returns the position of each sample of the map in the shrunk picture.

    Far outside if the lens does not see it.
    """
    centres = (np.arange(edge) + 0.5) / edge
    uv = np.stack(np.meshgrid(centres, centres), axis=-1)
    pixels = lens.project(hemisphere_direction(uv).reshape(-1, 3))
    places = np.nan_to_num((pixels + 0.5) / shrink - 0.5, nan=-100.0)
    return places.reshape(edge, edge, 2).astype(np.float32)


def _cells(
    lens: FisheyeLens, shape: tuple[int, ...], shrink: int
) -> tuple[Float64[np.ndarray, "y x"], Float64[np.ndarray, "y x"], Bool[np.ndarray, "y x"]]:
    """Returns every cell's angle from the axis (at most 90 degrees), solid angle (0 at the rim), and membership.

    A cell is a member if it is in the map.
    """
    rows, columns = shape
    corner = np.stack(np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0)), axis=-1) * shrink - 0.5
    rays = lens.directions(corner.reshape(-1, 2)).reshape(rows + 1, columns + 1, 3)
    solid = (
        np.linalg.norm(np.cross(rays[1:, 1:] - rays[:-1, :-1], rays[1:, :-1] - rays[:-1, 1:]), axis=-1) / 2
    )
    middle = (corner[:-1, :-1] + corner[1:, 1:]) / 2
    z = lens.directions(middle.reshape(-1, 2))[:, 2].reshape(rows, columns)
    angle = np.minimum(np.arccos(np.clip(z, -1, 1)), np.pi / 2)
    # A cell on the rim may have its centre outside: it is as far from the axis as the lens sees.
    angle = np.where(np.isfinite(angle), angle, np.nanmax(angle))
    return angle, np.nan_to_num(solid), np.asarray(z > 0)


def _flux_gain(
    places: Float32[np.ndarray, "edge edge 2"],
    size: int,
    inside: Float32[np.ndarray, "y x"],
    solid: Float64[np.ndarray, "y x"],
) -> Float64[np.ndarray, "y x"]:
    """Returns each cell's solid angle over the one that the map's samples give it.

    1 near the horizon and the rim of the image circle, where samples end and texels are divided by their coverage.
    """
    per_texel = len(places) // size
    samples = np.repeat(np.repeat(texel_solid_angles(size), per_texel, 0), per_texel, 1) / per_texel**2
    given = _spread(places, samples.astype(np.float64), inside.shape)
    reached = _spread(places, np.ones_like(samples, np.float64), inside.shape) > 0
    whole = (reached & (inside > 0.999) & (solid > 0)).astype(np.uint8)
    # Two cells: the sample's footprint, and its own distance from the edge.
    interior = cv2.erode(whole, np.ones((5, 5), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    return np.where(interior, solid / np.maximum(given, 1e-30), 1.0)


def _spread(
    places: Float32[np.ndarray, "edge edge 2"],
    values: Float64[np.ndarray, "edge edge"],
    shape: tuple[int, ...],
) -> Float64[np.ndarray, "y x"]:
    """Adds every sample's value to the four cells that it reads, with the same weights."""
    result = np.zeros(shape[0] * shape[1])
    low = np.floor(places).astype(np.intp)
    part = places - low
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = low[..., 0] + dx, low[..., 1] + dy
            weight = np.abs(1 - dx - part[..., 0]) * np.abs(1 - dy - part[..., 1]) * values
            ok = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
            result += np.bincount(y[ok] * shape[1] + x[ok], weight[ok], result.size)
    return result.reshape(shape)
