"""Field types that the parts of the scene document share."""

import math
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Field, StringConstraints

T = TypeVar("T")

# How a map of radiance is cut into lights, in scenes, settings of nodes and messages alike.
LightCount = Annotated[int, Field(ge=1, le=16)]
SplitKind = Literal["peaks", "all"]
PeakThreshold = Annotated[float, Field(gt=0, le=1000)]
SmoothingTime = Annotated[float, Field(ge=0, le=60)]

View = Literal["composite", "effects", "delta", "error", "volume", "rsm", "lights"]
ShownView = Literal[
    View, "camera"
]  # what can be looked at; `camera` is the picture before anything was done to it


def _unit(values: tuple[float, ...]) -> tuple[float, ...]:
    """Normalises a vector; a unit vector keeps its bits."""
    length = math.sqrt(sum(value * value for value in values))
    if length < 1e-9:
        raise ValueError("its length must not be zero")
    return values if abs(length - 1) < 1e-12 else tuple(value / length for value in values)


def _unit_vector(values: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = _unit(values)
    return x, y, z


def _unit_quaternion(values: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    w, x, y, z = _unit(values)
    return w, x, y, z


def without_nul(value: T) -> T:
    """Refuses what no text in PostgreSQL can hold, and no file name.

    Raises:
        ValueError: the value is a text with a NUL character.
    """
    if isinstance(value, str) and "\0" in value:
        raise ValueError("must not hold a NUL character; leave it out")
    return value


Text = Annotated[str, AfterValidator(without_nul)]
Coordinate = Annotated[float, Field(gt=-1e4, lt=1e4)]
Fraction = Annotated[float, Field(ge=0, le=1)]
NonNegative = Annotated[float, Field(ge=0, le=1e9)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Colour = tuple[Fraction, Fraction, Fraction]
Radiance = tuple[NonNegative, NonNegative, NonNegative]
Direction = Annotated[tuple[Coordinate, Coordinate, Coordinate], AfterValidator(_unit_vector)]
Quaternion = Annotated[
    tuple[Coordinate, Coordinate, Coordinate, Coordinate], AfterValidator(_unit_quaternion)
]
Asset = Annotated[str, StringConstraints(min_length=1, max_length=4096)]
ASSET_TEXT = "`sha256:<hex>`, an uploaded asset's name, or a path relative to the document."
