"""Buffers of light propagation volumes (passes/common/light_cells.glsl), and the weights of a step (METHOD 5)."""

import math
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float64

from render_server.gpu.context import GpuContext

COEFFICIENT_BYTES = 16  # a cell and channel: 4 floats
INJECTED_SUMS = 12  # a cell: 4 coefficients x 3 channels
COVERED_SUMS = 6  # a cell: its low faces on three axes, surfaces that face - and +
CONSTANT, LINEAR = 0.5 / math.sqrt(math.pi), math.sqrt(3 / (4 * math.pi))  # Y_0 and Y_1 along its axis
LOBE = (math.sqrt(math.pi) / 2, math.sqrt(math.pi / 3))  # clamped cosine in them
FAR_FACE_SR, SIDE_FACE_SR = 0.40067, 0.42343  # as seen from the centre of the neighbouring cell
DIRECTION_LENGTH = 10 / 32  # of the volume's edge: over so much a step's filter lets directions fade


@dataclass(frozen=True)
class StepWeights:
    """What of a cell's coefficients goes on to a neighbour, for both directions of an axis up to sign.

    `transfer`: (constant from constant, constant from along, along from constant, along from along);
    `sideways`: across from across, the same for both. The 4x4 matrix has no other non-zeros.
    """

    transfer: tuple[float, float, float, float]
    sideways: float


def lobe_weights() -> StepWeights:
    """Flux through each far and side face of the cell, sent on as a cosine lobe about that face ([P2], METHOD 5)."""
    slant = 2 / math.sqrt(5)  # cosine from the way to the centre of a side face
    flux = (FAR_FACE_SR + 4 * SIDE_FACE_SR, FAR_FACE_SR + 4 * SIDE_FACE_SR * slant)
    shape = (LOBE[0] / math.pi, LOBE[1] / math.pi)
    transfer = (
        shape[0] * CONSTANT * flux[0],
        shape[0] * LINEAR * flux[1],
        shape[1] * CONSTANT * FAR_FACE_SR,
        shape[1] * LINEAR * FAR_FACE_SR,
    )
    sideways = shape[1] * LINEAR * SIDE_FACE_SR * 2 * math.sqrt(1 - slant**2)
    return StepWeights(transfer, sideways)


def moment_weights(cells: int) -> StepWeights:
    """Light keeps its direction: the integral of y_i y_j over the directions that pass the shared face.

    A sixth of the sphere each, so the six matrices sum to the identity. Then a small share of the linear part is left
    out (a filter as for P_N transport, McClarren & Hauck 2010): without it, steps of the truncated series overshoot.
    DIRECTION_LENGTH is such that a square emitter of a quarter of the volume's edge does not light itself; it then
    lights a floor before it within 0.02 of the form factor. Cosine lobes light it with half of its own radiosity.
    """
    kept = 1 - 1 / (DIRECTION_LENGTH * cells)
    nodes, weights = np.polynomial.legendre.leggauss(32)
    u, v = np.meshgrid(nodes, nodes)
    distance2 = 1 + u**2 + v**2
    solid_angle = np.outer(weights, weights) * distance2**-1.5
    cosine, lateral = distance2**-0.5, u * distance2**-0.5

    def moment(a: Float64[np.ndarray, "n n"], b: Float64[np.ndarray, "n n"]) -> float:
        return float((a * b * solid_angle).sum())

    one = np.full_like(u, CONSTANT)
    along, aside = LINEAR * cosine, LINEAR * lateral
    mixed = moment(one, along)
    transfer = (moment(one, one), mixed, kept * mixed, kept * moment(along, along))
    return StepWeights(transfer, kept * moment(aside, aside))


class LightVolume:
    """State between steps (two buffers in turn) and the total, 3 channels x cells x 4 coefficients each."""

    def __init__(self, gpu: GpuContext, cells: int) -> None:
        self.cells = cells
        size = 3 * cells**3 * COEFFICIENT_BYTES
        self.state, self.next_state, self.total = (gpu.ctx.buffer(reserve=size) for _ in range(3))

    def swap(self) -> None:
        """What was written becomes the state."""
        self.state, self.next_state = self.next_state, self.state

    def release(self) -> None:
        """Free the buffers."""
        for buffer in (self.state, self.next_state, self.total):
            buffer.release()


def injected_sums(gpu: GpuContext, cells: int) -> moderngl.Buffer:
    """Fixed-point sums of injected light, empty."""
    return _zeros(gpu, cells**3 * INJECTED_SUMS * 4)


def covered_sums(gpu: GpuContext, cells: int) -> moderngl.Buffer:
    """Fixed-point sums of covered faces, empty."""
    return _zeros(gpu, cells**3 * COVERED_SUMS * 4)


def transmitted_shares(gpu: GpuContext, cells: int) -> moderngl.Buffer:
    """What gets into each cell from its neighbours, packed; nothing until lpv_transmit wrote it."""
    return _zeros(gpu, cells**3 * 8)


def _zeros(gpu: GpuContext, size: int) -> moderngl.Buffer:
    buffer = gpu.ctx.buffer(reserve=size)
    buffer.clear()
    return buffer
