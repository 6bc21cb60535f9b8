"""GLB files of the shelf's objects."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import trimesh

EMISSIVE_STRENGTH = "KHR_materials_emissive_strength"
_Y_FROM_Z = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # glTF: y is up


def glb(shape: "trimesh.Trimesh | trimesh.Scene", strengths: Mapping[str, float] | None = None) -> bytes:
    """Returns the file of a shape (z up, metres), the same bytes each time.

    `strengths` multiply the emissive factors of materials of these names.
    """
    shape.apply_transform(_Y_FROM_Z)
    given = strengths or {}
    content: bytes = shape.export(file_type="glb", tree_postprocessor=lambda tree: _strengthen(tree, given))
    return content


def _strengthen(tree: dict[str, Any], strengths: Mapping[str, float]) -> None:
    for material in tree.get("materials", ()):
        if material.get("name") in strengths:
            strength = {"emissiveStrength": strengths[material["name"]]}
            material.setdefault("extensions", {})[EMISSIVE_STRENGTH] = strength
    if strengths:
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", []), EMISSIVE_STRENGTH]
