"""Transforms between the sensors (calibration/extrinsics.yaml of docs/formats.md 1)."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from jaxtyping import Float64

from deltalight.protocol.documents import nearest, read_mapping
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.poses import require_rigid


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Rigid (4, 4) transforms, None where not calibrated.

    `depth_from_rgb` and `rgb_from_fisheye` join sensors that move together; `world_from_fisheye` places a
    fixed probe.
    """

    depth_from_rgb: Float64[np.ndarray, "4 4"] | None = None
    rgb_from_fisheye: Float64[np.ndarray, "4 4"] | None = None
    world_from_fisheye: Float64[np.ndarray, "4 4"] | None = None

    def to_dict(self) -> dict[str, list[list[float]]]:
        """Returns the known transforms as plain rows."""
        known = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: matrix.tolist() for name, matrix in known.items() if matrix is not None}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], name: str) -> Self:
        """Validates the transforms of a document called `name`.

        Raises:
            DeltalightError: a key is unknown, or a transform is not rigid.
        """
        known = [field.name for field in fields(cls)]
        for key in data:
            if key not in known:
                hint = nearest(str(key), known)
                raise DeltalightError(
                    f"{name}: unknown key `{key!s:.60}`; the nearest known key is `{hint or known[0]}`."
                )
        return cls(**{key: require_rigid(_matrix(value), f"{name}: `{key}`") for key, value in data.items()})


def _matrix(value: Any) -> Any:  # noqa: ANN401 - whatever the document holds
    return value["data"] if isinstance(value, Mapping) and "data" in value else value


def load_extrinsics_yaml(path: Path) -> Extrinsics:
    """Reads calibration/extrinsics.yaml (matrices as rows, flat, or `{rows, cols, data}`).

    Raises:
        DeltalightError: the file or one of its transforms is wrong.
    """
    return Extrinsics.from_dict(read_mapping(path), str(path))


def save_extrinsics_yaml(path: Path, extrinsics: Extrinsics) -> None:
    """Writes the known transforms as rows."""
    path.write_text(yaml.safe_dump(extrinsics.to_dict(), default_flow_style=None), encoding="utf-8")
