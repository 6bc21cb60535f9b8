"""Bisection of triangles until none is longer than asked."""

import numpy as np
from jaxtyping import Float32

from deltalight.protocol import short_axis
from deltalight.protocol.errors import DeltalightError

MAX_PIECES = 4_000_000


def split_triangles(corners: Float32[np.ndarray, "m 3 c"], max_edge: float) -> Float32[np.ndarray, "k 3 c"]:
    """Bisects longest edges until none is longer than `max_edge` (same unit as the positions).

    Columns 0..2 of a corner are its position; all other columns (normal, uv, material index...) are
    interpolated linearly with it. Triangles that are short enough come first, unchanged and in order.
    (llvmpipe ends loops of a shader invocation early, so voxelisation needs triangles of bounded size.)

    Raises:
        DeltalightError: more than 4 million triangles would result.
    """
    done: list[np.ndarray] = []
    pending = np.ascontiguousarray(corners, np.float32)
    _check_pieces(pending, max_edge)
    while len(pending):
        edges = np.roll(pending[..., :3], -1, axis=1) - pending[..., :3]
        lengths = short_axis.lengths(edges)
        long = short_axis.greatest(lengths) > max_edge
        done.append(pending[~long])
        pending = _bisected(pending[long], lengths[long].argmax(axis=1))
    return np.concatenate(done) if done else np.zeros_like(pending)


def _check_pieces(corners: Float32[np.ndarray, "m 3 c"], max_edge: float) -> None:
    """Refuses by a lower bound on the number of pieces, before memory runs out.

    An equilateral triangle is the largest that the limit allows; bisection makes a few times as many.
    """
    edges = np.roll(corners[..., :3], -1, axis=1) - corners[..., :3]
    areas = short_axis.lengths(np.cross(edges[:, 0], edges[:, 1])) / 2
    by_area = areas / (np.sqrt(3) / 4 * max_edge**2)
    by_length = short_axis.greatest(short_axis.lengths(edges)) / max_edge
    if np.maximum(by_area, by_length).sum() > MAX_PIECES:
        raise DeltalightError(
            f"a mesh splits into more than {MAX_PIECES} triangles; use fewer voxels or a smaller mesh."
        )


def _bisected(corners: Float32[np.ndarray, "m 3 c"], edge: np.ndarray) -> Float32[np.ndarray, "k 3 c"]:
    """Cuts every triangle at the midpoint of its edge number `edge` (from corner `edge` to the next)."""
    row = np.arange(len(corners))
    start, end, opposite = (corners[row, (edge + step) % 3] for step in range(3))
    middle = (start + end) * np.float32(0.5)
    halves = [np.stack([start, middle, opposite], axis=1), np.stack([middle, end, opposite], axis=1)]
    return np.concatenate(halves)
