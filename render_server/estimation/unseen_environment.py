"""Estimates of unobserved light: from the ground, from planes beyond the picture, and from everything else."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.frames import LUMINANCE, decode_lut
from deltalight.protocol.octahedral import octahedral_uv
from deltalight.render_server.estimation.plane_extrapolation import (
    ExtrapolatedPlanes,
    PointCloud,
    RealSamples,
    ViewFrustum,
    detect_planes,
    extrapolate_planes,
)
from deltalight.render_server.estimation.registration import unseen_radiance_from_patch
from deltalight.render_server.estimation.samples import LightSamples
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.octahedral import irradiance_map

GROUND_SIZES = 2.0
FACES_UP = 0.7  # cosine to the vertical

PLANE_SAMPLES = 6000  # pixels used to detect planes: the smallest accepted plane still has a hundred
FLATNESS = 0.01  # of the distance: tolerance of walls, tables and lenses


def find_extrapolated_planes(graph: FrameGraph, lights: LightSet, known: LightSamples) -> ExtrapolatedPlanes:
    """Extrapolates table, walls or floor where the picture's border cuts them (plane_extrapolation.py).

    `known` are samples under `lights`.
    """
    inputs = graph.inputs
    usable = np.flatnonzero(known.usable)
    chosen = usable[:: max(1, len(usable) // PLANE_SAMPLES)]
    position, pixel = known.position[chosen], known.pixel[chosen]
    normal = read_texture(graph.observation.surface.normal)[pixel[:, 1], pixel[:, 0], :3]
    pose = inputs.view.world_from_camera
    depth = (position - pose[:3, 3]) @ pose[:3, 2]
    tolerance = np.maximum(3 * inputs.scan.noise_sigma * depth**2, FLATNESS * depth)
    indirect = (known.light + known.bounce - known.direct)[chosen]
    seen = RealSamples(position, known.measured[chosen], known.lit[chosen], indirect, tolerance)
    rays = inputs.frame.camera.rays().reshape(-1, 2).astype(np.float64)
    sight = ViewFrustum(np.linalg.inv(pose), rays.min(axis=0), rays.max(axis=0))
    low, high = inputs.objects.bounds
    planes = detect_planes(PointCloud(position, normal, tolerance))
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
    board, paper = graph.inputs.frame.board, known.of(known.usable & (known.albedo > 0))
    if board is None or (board.white_albedo is None and not board.grey_cards) or not len(paper.albedo):
        return None
    black = replace(lights, environment=np.zeros_like(lights.environment))
    total = paper.direct + paper.gather(graph, lights)
    even = paper.gather(graph, black.with_sky(np.ones(3, np.float32), shape)) - paper.bounce
    return unseen_radiance_from_patch(paper.measured, total, even, paper.albedo)


def ground_radiance(graph: FrameGraph) -> Float32[np.ndarray, "3"] | None:
    """Returns the mean radiance of upward-facing surfaces within two object sizes (docs/method.md 2)."""
    surface, frame = graph.observation.surface, graph.inputs.frame
    position, normal = read_texture(surface.position), read_texture(surface.normal)
    low, high = graph.inputs.objects.bounds
    away = np.linalg.norm(position[..., :3] - (low + high) / 2, axis=-1)
    near = (position[..., 3] > 0) & (away <= GROUND_SIZES * float(np.max(high - low)))
    ground = near & (normal[..., 2] > FACES_UP)
    if not ground.any():
        return None
    coded = decode_lut(frame.response)[frame.color[ground], np.arange(3)]
    return np.asarray(coded.mean(axis=0) / frame.exposure_scale, np.float32)


def unseen_light_shape(graph: FrameGraph, size: int) -> Float32[np.ndarray, "n n 1"]:
    """Returns the distribution of unseen light over an octahedral map: 1 in its strongest direction.

    Unseen walls adjoin visible ones, so the distribution is the light that the visible surfaces above the horizon, as
    seen from the objects, would send to a surface facing each direction: as smooth as irradiance. It is uniform if no
    such surface is visible.
    """
    frame = graph.inputs.frame
    position = read_texture(graph.observation.surface.position)
    low, high = graph.inputs.objects.bounds
    direction = position[..., :3] - (low + high) / 2
    seen = (position[..., 3] > 0) & (direction[..., 2] > 0)
    luminance = decode_lut(frame.response)[frame.color[seen], np.arange(3)] @ LUMINANCE
    texel = np.minimum((octahedral_uv(direction[seen]) * size).astype(int), size - 1)
    flat = texel[:, 1] * size + texel[:, 0]
    count = np.bincount(flat, minlength=size * size)
    mean = np.bincount(flat, luminance, size * size) / np.maximum(count, 1)
    seen_radiance = np.repeat(mean.reshape(size, size, 1), 3, axis=2).astype(np.float32)
    shape = irradiance_map(seen_radiance)[..., :1]
    return shape / shape.max() if shape.max() > 0 else np.ones_like(shape)
