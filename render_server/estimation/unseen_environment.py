"""Estimates of unobserved light: from the ground, from planes beyond the picture, and from everything else."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int64

from deltalight.protocol import short_axis
from deltalight.protocol.frames import LUMINANCE
from deltalight.protocol.octahedral import octahedral_texels
from deltalight.render_server.estimation.plane_extrapolation import (
    ExtrapolatedPlanes,
    PointCloud,
    RealSamples,
    ViewFrustum,
    detect_planes,
    extrapolate_planes,
)
from deltalight.render_server.estimation.registration import unseen_radiance_from_patch
from deltalight.render_server.estimation.samples import LightSamples, SeenSurface, decoded
from deltalight.render_server.frame import Observation
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.octahedral import irradiance_map

GROUND_SIZES = 2.0
FACES_UP = 0.7  # cosine to the vertical

PLANE_SAMPLES = 6000  # pixels used to detect planes: the smallest accepted plane still has 15
FLATNESS = 0.01  # of the distance: tolerance of walls, tables and lenses


def find_extrapolated_planes(graph: FrameGraph, lights: LightSet, known: LightSamples) -> ExtrapolatedPlanes:
    """Extrapolates table, walls or floor where the picture's border cuts them (plane_extrapolation.py).

    `known` are samples under `lights`.
    """
    inputs = graph.inputs
    usable = np.flatnonzero(known.usable)
    some = known.of(usable[:: max(1, len(usable) // PLANE_SAMPLES)])
    position, pose = some.position, inputs.view.world_from_camera
    depth = (position - pose[:3, 3]) @ pose[:3, 2]
    tolerance = np.maximum(3 * inputs.scan.noise_sigma * depth**2, FLATNESS * depth)
    indirect = some.light + some.bounce - some.direct
    seen = RealSamples(position, some.measured, some.lit, indirect, tolerance)
    first, last = short_axis.bounds(inputs.frame.camera.rays().reshape(-1, 2))
    sight = ViewFrustum(np.linalg.inv(pose), first.astype(np.float64), last.astype(np.float64))
    low, high = inputs.objects.bounds
    planes = detect_planes(PointCloud(position, some.normal, tolerance))
    size = len(lights.environment)
    return extrapolate_planes(planes, seen, lights.lights, sight, centre=(low + high) / 2, size=size)


def find_unseen_light(
    graph: FrameGraph, lights: LightSet, shape: Float32[np.ndarray, "n n 1"], known: LightSamples
) -> Float32[np.ndarray, "3"] | None:
    """Estimates the radiance, times `shape`, of what neither camera nor lights show.

    Walls beside and behind the camera reflect light too. On paper of known albedo the picture gives the irradiance;
    what the lights and the visible scene leave unexplained comes from those walls. None without such paper.
    `known` are samples under the same lamps as `lights`, whatever the environment.
    """
    board = graph.inputs.frame.board
    if board is None or (board.white_albedo is None and not board.grey_cards):
        return None
    paper = known.of(known.usable & (known.albedo > 0))
    if not len(paper.pixel):
        return None
    black = replace(lights, environment=np.zeros_like(lights.environment))
    total = paper.direct + paper.gather(graph, lights)
    even = paper.gather(graph, black.with_sky(np.ones(3, np.float32), shape)) - paper.bounce
    return unseen_radiance_from_patch(paper.measured, total, even, paper.albedo)


def ground_radiance(graph: FrameGraph) -> Float32[np.ndarray, "3"] | None:
    """Returns the mean radiance of upward-facing surfaces within two object sizes (docs/method.md 2)."""
    frame, resources = graph.inputs.frame, graph.resources
    ground = graph.kept(_ground_pixels, resources.observation, resources.objects)
    if not len(ground):
        return None
    coded = decoded(frame, frame.color.reshape(-1, 1, 3)[ground])[:, 0]
    return np.asarray(coded.mean(axis=0) / frame.exposure_scale, np.float32)


def _ground_pixels(seen: Observation, objects: GeometryState) -> Int64[np.ndarray, " k"]:
    """Returns the pixels that show upward-facing surfaces within two object sizes."""
    surface, (low, high) = SeenSurface.of(seen), objects.bounds
    away = np.linalg.norm(surface.position[:, :3].astype(np.float64) - (low + high) / 2, axis=-1)
    near = (surface.position[:, 3] > 0) & (away <= GROUND_SIZES * float(np.max(high - low)))
    return np.flatnonzero(near & (surface.normal[:, 2].astype(np.float64) > FACES_UP))


def unseen_light_shape(graph: FrameGraph, size: int) -> Float32[np.ndarray, "n n 1"]:
    """Returns the distribution of unseen light over an octahedral map: 1 in its strongest direction.

    Unseen walls adjoin visible ones, so the distribution is the light that the visible surfaces above the horizon, as
    seen from the objects, would send to a surface facing each direction: as smooth as irradiance. It is uniform if no
    such surface is visible.
    """
    frame, resources = graph.inputs.frame, graph.resources
    seen = graph.kept(SkyPixels.of, resources.observation, resources.objects, size=size)
    codes = frame.color.reshape(-1, 1, 3)[seen.pixel]
    luminance = decoded(frame, codes)[:, 0] @ LUMINANCE
    mean = np.bincount(seen.texel, luminance, size * size) / np.maximum(seen.count, 1)
    seen_radiance = np.repeat(mean.reshape(size, size, 1), 3, axis=2).astype(np.float32)
    shape = irradiance_map(seen_radiance)[..., :1]
    return shape / shape.max() if shape.max() > 0 else np.ones_like(shape)


@dataclass(frozen=True, eq=False)
class SkyPixels:
    """Pixels that show surfaces above the objects' horizon, and the texels of an octahedral map that they lie in.

    `count`: how many lie in each texel.
    """

    pixel: Int64[np.ndarray, " k"]
    texel: Int64[np.ndarray, " k"]
    count: Int64[np.ndarray, " n"]

    @classmethod
    def of(cls, seen: Observation, objects: GeometryState, *, size: int) -> "SkyPixels":
        """Finds them; `size` is the map's edge in texels."""
        surface, (low, high) = SeenSurface.of(seen), objects.bounds
        direction = surface.position[:, :3].astype(np.float64) - (low + high) / 2
        pixel = np.flatnonzero((surface.position[:, 3] > 0) & (direction[:, 2] > 0))
        column, row = octahedral_texels(direction[pixel], size).T
        flat = row * size + column
        return cls(pixel, flat, np.bincount(flat, minlength=size * size))
