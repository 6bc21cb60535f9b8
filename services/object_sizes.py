"""Objects whose files are probably not in metres: they would fill the picture, or vanish in it, without a word."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import SceneObject

# As the dashboard judges them (services/dashboard/src/math/bounds.ts).
SMALLEST_M = 0.01
LARGEST_M = 1.0
SENSIBLE_M = 0.2
UNITS = {0.01: "centimetres", 0.001: "millimetres"}


def size_warnings(scene: SceneDocument) -> Iterator[str]:
    """Yields a sentence for each visible object longer than 1 m or shorter than 1 cm, with the scale to give it.

    Raises:
        DeltalightError: an asset cannot be read.
    """
    edges_m: dict[str, float] = {}
    for item in scene.objects:
        if item.visible:
            if item.asset not in edges_m:
                edges_m[item.asset] = _longest_edge(Path(item.asset))
            edge_m = edges_m[item.asset] * item.pose.scale
            if edge_m > 0 and not SMALLEST_M <= edge_m <= LARGEST_M:
                yield _warning(item, edge_m)


def _longest_edge(path: Path) -> float:
    from deltalight.render_server.scene.mesh_loading import load_mesh

    bounds = np.stack([mesh.bounds() for mesh in load_mesh(path)])
    return float(np.max(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)))


def _warning(item: SceneObject, edge_m: float) -> str:
    factor = likely_factor(edge_m)
    unit = f" If its file is in {UNITS[factor]}," if factor in UNITS else " If that is not meant,"
    return (
        f"warning: object `{item.id}` is {_length(edge_m)} long.{unit}"
        f' write "scale": {item.pose.scale * factor:g} in its pose.'
    )


def likely_factor(edge_m: float) -> float:
    """Returns the factor from the likely unit of a file to metres: centimetres, millimetres, or a power of ten."""
    if edge_m > LARGEST_M:
        return min(UNITS, key=lambda factor: abs(math.log(edge_m * factor / SENSIBLE_M)))
    return float(10.0 ** round(math.log10(SENSIBLE_M / edge_m)))


def _length(edge_m: float) -> str:
    return f"{edge_m:.3g} m" if edge_m > LARGEST_M else f"{1000 * edge_m:.3g} mm"
