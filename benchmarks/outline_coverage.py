"""How much of its pixels a shape covers: by samples, and by the steps of its outline (docs/how-a-frame-is-made.md).

`python -m deltalight.benchmarks.outline_coverage` takes half a minute of one core and prints the table of errors.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from rich.console import Console
from rich.table import Table

from deltalight.render_server.passes.coverage import PATTERN, STEPS

EDGE = 32  # of what is compared of a picture, pixels
FINE = 32  # samples an edge of a pixel that tell the truth
LONGEST = 32  # pixels that the ends of a step are searched for, each way
MARGIN = LONGEST + 1  # of a picture around what is compared
SEED = 1
AXIS_DEG = 10.0
FOUR = ((-2, -6), (6, -2), (-6, 2), (2, 6))
"""Sample positions of the usual rotated grid, in the units of PATTERN."""

Inside = Callable[[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]], Bool[np.ndarray, "*n"]]
Mask = Bool[np.ndarray, "h w"]
Coverage = Float64[np.ndarray, "h w"]


@dataclass(frozen=True)
class Shape:
    """A shape by its points, pixels from the picture's middle; `kind` is the column that it counts in."""

    kind: str
    inside: Inside


def half_plane(angle: float, offset: float, kind: str) -> Shape:
    """Everything on one side of a line with this normal."""
    return Shape(kind, lambda x, y: x * np.cos(angle) + y * np.sin(angle) < offset)


def bar(angle: float, offset: float, width: float) -> Shape:
    """A line of this width, as long as the picture."""
    return Shape(
        f"bars {width:g} px", lambda x, y: np.abs(x * np.cos(angle) + y * np.sin(angle) - offset) < width / 2
    )


def disc(radius: float, x0: float, y0: float) -> Shape:
    """A disc about a point."""
    return Shape("discs", lambda x, y: (x - x0) ** 2 + (y - y0) ** 2 < radius**2)


def shapes(count: int, rng: np.random.Generator) -> Iterator[Shape]:
    """Yields that many of each kind, at random angles and positions."""
    for _ in range(count):
        angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-2, 2)
        yield half_plane(angle, offset, "half planes")
        near = np.radians(rng.uniform(-AXIS_DEG, AXIS_DEG)) + np.pi / 2 * rng.integers(4)
        yield half_plane(float(near), offset, "near an axis")
        yield disc(rng.uniform(3, 10), *rng.uniform(-0.5, 0.5, 2))
        for width in (1.0, 0.5):
            yield bar(angle, offset, width)


def sampled(shape: Shape, pattern: Float64[np.ndarray, "n 2"], edge: int = EDGE) -> Coverage:
    """Returns the fraction of each pixel's samples inside; `pattern` is in pixels from its middle."""
    rows, columns = np.mgrid[:edge, :edge] - (edge - 1) / 2
    found = [shape.inside(columns + x, rows + y) for x, y in pattern]
    return np.asarray(np.mean(found, axis=0))


def evenly() -> Float64[np.ndarray, "n 2"]:
    """Returns FINE x FINE samples of a pixel."""
    at = (np.arange(FINE) + 0.5) / FINE - 0.5
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def from_outline(shape: Shape) -> Coverage:
    """Returns what `by_steps` makes of one sample a pixel."""
    mask = sampled(shape, np.zeros((1, 2)), EDGE + 2 * MARGIN) > 0
    return by_steps(mask)[MARGIN:-MARGIN, MARGIN:-MARGIN]


def by_steps(mask: Mask) -> Coverage:
    """Returns coverage by morphological antialiasing (Reshetov 2009): lines in place of the outline's steps.

    Each step's line goes from half a pixel aside, where the outline turns at its end, to none in its middle. What
    the line cuts off a pixel takes the value beyond the step. Of steps between rows and between columns, those count
    that cut off more (SMAA, Jimenez et al. 2012).
    """
    rows, columns = _changed(mask), _changed(mask.T).T
    return np.asarray(mask + np.where(np.abs(rows) > np.abs(columns), rows, columns))


def _changed(mask: Mask) -> Coverage:
    """Returns by how much the lines of steps between rows change the coverage."""
    (above, below), beyond = _cut_off(mask), mask[1:].astype(float) - mask[:-1]
    found = np.zeros(mask.shape)
    found[:-1] += above * beyond
    found[1:] -= below * beyond
    return found


def _cut_off(mask: Mask) -> tuple[Coverage, Coverage]:
    """Returns the areas that the lines of steps between rows cut off the pixels above, and off those below."""
    step = mask[1:].astype(int) - mask[:-1]
    areas = np.zeros((2, *step.shape))
    for row, columns in _runs(step):
        first, last = columns
        height = [_turn(mask, step, row, first, first - 1), _turn(mask, step, row, last, last + 1)]
        for column in range(first, last + 1):
            for begin, from_end in zip(height, (column - first, last - column), strict=True):
                area = _area_under(from_end, last - first + 1)
                areas[0 if begin > 0 else 1, row, column] += abs(begin) * area
    return areas[0], areas[1]


def _runs(step: Int64[np.ndarray, "h w"]) -> Iterator[tuple[int, tuple[int, int]]]:
    """Yields rows, and the first and last columns of stretches of one step."""
    for row, values in enumerate(step):
        ends = np.flatnonzero(np.diff(values)) + 1
        for part in np.split(np.arange(len(values)), ends):
            if values[part[0]] != 0:
                yield row, (int(part[0]), int(part[-1]))


def _turn(mask: Mask, step: Int64[np.ndarray, "h w"], row: int, column: int, beyond: int) -> float:
    """Returns where the line begins: half a pixel up or down, as the outline turns; 0 where it does not or both."""
    if not 0 <= beyond < mask.shape[1] or step[row, beyond] != 0:
        return 0.0
    return 0.5 if mask[row, beyond] != mask[row, column] else -0.5


def _area_under(from_end: int, length: int) -> float:
    """Returns the area in a pixel below a line that falls from 1 at its end of a run to 0 in the run's middle."""
    if from_end >= LONGEST:
        return 0.0
    near, far = (min(2 * at / length, 1.0) for at in (from_end, from_end + 1))
    return ((far - near) - (far**2 - near**2) / 2) * length / 2


METHODS: dict[str, Callable[[Shape], Coverage]] = {
    "one sample": lambda shape: sampled(shape, np.zeros((1, 2))),
    "MLAA": from_outline,
    "4 samples": lambda shape: sampled(shape, np.array(FOUR) / STEPS),
    "8 samples": lambda shape: sampled(shape, np.array(PATTERN) / STEPS),
}


def errors(count: int, seed: int = SEED) -> dict[str, dict[str, Float64[np.ndarray, " n"]]]:
    """Returns each method's errors by kind of shape, where an outline cuts a pixel or it comes out wrong."""
    found: dict[str, dict[str, list[np.ndarray]]] = {name: {} for name in METHODS}
    truth_pattern = evenly()
    for shape in shapes(count, np.random.default_rng(seed)):
        truth = sampled(shape, truth_pattern)
        for name, method in METHODS.items():
            error = method(shape) - truth
            counts = ((truth > 0) & (truth < 1)) | (error != 0)
            found[name].setdefault(shape.kind, []).append(error[counts])
    return {
        name: {kind: np.concatenate(parts) for kind, parts in kinds.items()} for name, kinds in found.items()
    }


def main() -> None:
    """Prints the table."""
    kinds = ("half planes", "near an axis", "discs", "bars 1 px", "bars 0.5 px")
    table = Table("", "half planes: worst", *(f"{kind}: r.m.s." for kind in kinds))
    for name, of in errors(200).items():
        worst = np.abs(of["half planes"]).max()
        rms = (f"{np.sqrt(np.mean(of[kind] ** 2)):.3f}" for kind in kinds)
        table.add_row(name, f"{worst:.2f}", *rms)
    Console().print(table)


if __name__ == "__main__":
    main()
