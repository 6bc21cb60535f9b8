"""Field types of the wire's messages, with their limits (SPEC.md, section 3)."""

import math
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import AfterValidator, Field, StringConstraints

from deltalight.protocol.documents import NAME_PATTERN

MAX_EDGE_PX = 16384
MAX_LIGHTS = 64
MAX_EXPOSURES = 24
MAX_LAMPS = 64
MAX_REGIONS = 16
MAX_PLAIN_DEPTH = 16
MAX_LABEL = 96
MAX_LABELS = 128
MAX_SENTENCE = 2000
OTHERS = "others"  # the sum of what is counted under labels beyond the allowed number
ROTATION_TOLERANCE = 1e-3
LENGTH_TOLERANCE = 1e-2


def _plain(value: object, depth: int = 0) -> object:
    """Refuses what JSON cannot express: other types, numbers that are not finite, deep nesting."""
    if depth > MAX_PLAIN_DEPTH:
        raise ValueError(f"is nested deeper than {MAX_PLAIN_DEPTH} levels")
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ValueError("has a key that is not text")
            _encodable(key)
            _plain(item, depth + 1)
    elif isinstance(value, list | tuple):
        for item in value:
            _plain(item, depth + 1)
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError("holds a number that is not finite")
    elif isinstance(value, str):
        _encodable(value)
    elif value is not None and not isinstance(value, int):
        raise ValueError(f"holds a {type(value).__name__}, which is not plain data")
    return value


def _encodable(text: str) -> None:
    """Refuses lone surrogates, which JSON can escape and no message can carry."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise ValueError("holds text with a lone surrogate") from error


def as_sentence(text: str) -> str:
    """Returns any text as a `Sentence`: cuts to its length, with question marks for lone surrogates."""
    return text[:MAX_SENTENCE].encode("utf-8", "replace").decode()


def as_counts(counts: Mapping[str, int]) -> dict[str, int]:
    """Returns any counts as `Counts`: labels cut to their length, those beyond the first 127 as one sum `others`."""
    kept: dict[str, int] = {}
    for label, count in counts.items():
        name = label[:MAX_LABEL]
        if name not in kept and len(kept) >= MAX_LABELS - 1:
            name = OTHERS
        kept[name] = kept.get(name, 0) + count
    return kept


def _rigid(rows: "Matrix4") -> "Matrix4":
    matrix = np.array(rows)
    rotation = matrix[:3, :3]
    if rows[3] != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("its last row must be 0 0 0 1")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError("it must be a rigid transform (a rotation with determinant +1, and a translation)")
    return rows


def _unit(vector: "Vector3") -> "Vector3":
    if abs(math.hypot(*vector) - 1) > LENGTH_TOLERANCE:
        raise ValueError("it must be a unit vector")
    return vector


def _power_of_two(size: int) -> int:
    if size & (size - 1):
        raise ValueError("it must be a power of two")
    return size


def _rectangle(edges: "Rectangle") -> "Rectangle":
    top, bottom, left, right = edges
    if top >= bottom or left >= right:
        raise ValueError("it must be from above to below and from left to right: top, bottom, left, right")
    return edges


Name = Annotated[str, StringConstraints(pattern=NAME_PATTERN)]
Label = Annotated[str, StringConstraints(min_length=1, max_length=MAX_LABEL)]
Sentence = Annotated[str, StringConstraints(max_length=MAX_SENTENCE)]
Nanoseconds = Annotated[int, Field(ge=0, le=2**63 - 1)]
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
Edge = Annotated[int, Field(ge=1, le=MAX_EDGE_PX, strict=True)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, strict=True)]
Seconds = Annotated[float, Field(gt=0, le=3600, strict=True)]
# Tuples are not strict because msgpack has one array type; their elements are.
Row4 = Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate], Field(strict=False)]
Matrix4 = Annotated[tuple[Row4, Row4, Row4, Row4], Field(strict=False)]
RigidMatrix = Annotated[Matrix4, AfterValidator(_rigid)]
Vector3 = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
UnitVector = Annotated[Vector3, AfterValidator(_unit)]
Strength = Annotated[float, Field(ge=0, le=1e12, strict=True)]
Strengths = Annotated[tuple[Strength, Strength, Strength], Field(strict=False)]
ResidualSize = Annotated[int, Field(ge=4, le=512, strict=True), AfterValidator(_power_of_two)]
TexelEdge = Annotated[int, Field(ge=0, le=MAX_EDGE_PX, strict=True)]
Rectangle = Annotated[tuple[TexelEdge, TexelEdge, TexelEdge, TexelEdge], Field(strict=False)]

RegionEdges = Annotated[Rectangle, AfterValidator(_rectangle)]
Channels = Annotated[int, Field(ge=3, le=3, strict=True)]
PictureShape = Annotated[tuple[Edge, Edge, Channels], Field(strict=False)]
DepthShape = Annotated[tuple[Edge, Edge], Field(strict=False)]
PlainDict = Annotated[dict[str, object], AfterValidator(_plain)]
LightList = Annotated[tuple[PlainDict, ...], Field(strict=False, max_length=MAX_LIGHTS)]
Durations = Annotated[dict[Label, Annotated[float, Field(ge=0, le=1e7)]], Field(max_length=MAX_LABELS)]
Counts = Annotated[dict[Label, Count], Field(max_length=MAX_LABELS)]
Rates = Annotated[dict[Label, Annotated[float, Field(ge=0, le=1e6)]], Field(max_length=MAX_LABELS)]


def matrix_rows(matrix: Float64[np.ndarray, "4 4"]) -> Matrix4:
    """Returns the rows of a matrix, as a message holds them."""
    first, second, third, fourth = ((float(a), float(b), float(c), float(d)) for a, b, c, d in matrix)
    return first, second, third, fourth
