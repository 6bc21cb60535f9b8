"""What a SPIR-V instruction counts: floating-point operations, and special functions.

A sum, difference or product is one operation a component, a fused one two. A quotient, root, power, exponential,
logarithm or trigonometric function is one special function a component: processors have units of their own for these,
or take many instructions. Functions of GLSL count what their definition in the GLSL specification (4.60, chapter 8)
takes. Comparisons, selections, minima, absolute values, rounding, changes of sign, conversions, integers and the
filtering of textures count nothing.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Cost:
    """Floating-point operations and special functions."""

    flops: int
    special: int = 0

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(self.flops + other.flops, self.special + other.special)


@dataclass(frozen=True)
class Shape:
    """Columns and rows of a floating-point type; a vector has one column, a scalar one row."""

    columns: int
    rows: int

    @property
    def count(self) -> int:
        """Components."""
        return self.columns * self.rows


NOTHING: Final = Cost(0)
SCALAR: Final = Shape(1, 1)
Weigh = Callable[[Shape, Shape], Cost]
"""What an instruction costs, of the shape of its result and that of its first operand."""


def _each(flops: int, special: int = 0) -> Weigh:
    """So many for each component of the result."""
    return lambda result, _: Cost(flops * result.count, special * result.count)


def _dot(size: int) -> int:
    return 2 * size - 1


def _determinant(edge: int) -> int:
    """By expansion along a row."""
    return 0 if edge == 1 else edge * (_determinant(edge - 1) + 2) - 1


def _inverse(edge: int) -> Cost:
    """By cofactors, whose first row gives the determinant, and one division."""
    return Cost(edge**2 * (_determinant(edge - 1) + 1) + _dot(edge), 1)


ONE, SPECIAL = _each(1), _each(0, 1)

INSTRUCTIONS: Final[Mapping[int, Weigh]] = {
    129: ONE,  # OpFAdd
    131: ONE,  # OpFSub
    133: ONE,  # OpFMul
    136: SPECIAL,  # OpFDiv
    140: _each(2, 1),  # OpFRem
    141: _each(2, 1),  # OpFMod: x - y * floor(x / y)
    142: ONE,  # OpVectorTimesScalar
    143: ONE,  # OpMatrixTimesScalar
    144: lambda result, vector: Cost(result.count * _dot(vector.rows)),  # OpVectorTimesMatrix
    145: lambda result, matrix: Cost(result.count * _dot(matrix.columns)),  # OpMatrixTimesVector
    146: lambda result, left: Cost(result.count * _dot(left.columns)),  # OpMatrixTimesMatrix
    147: ONE,  # OpOuterProduct
    148: lambda _, vector: Cost(_dot(vector.rows)),  # OpDot
    **dict.fromkeys((207, 208, 210, 211, 213, 214), ONE),  # OpDPdx, OpDPdy, as they are, fine and coarse
    **dict.fromkeys((209, 212, 215), _each(3)),  # OpFwidth
}
"""By opcode of SPIR-V (specification 1.6, 3.42); all others cost nothing."""

FUNCTIONS: Final[Mapping[int, Weigh]] = {
    10: ONE,  # Fract
    11: ONE,  # Radians
    12: ONE,  # Degrees
    **dict.fromkeys(range(13, 33), SPECIAL),  # Sin to InverseSqrt
    33: lambda _, matrix: Cost(_determinant(matrix.rows)),  # Determinant
    34: lambda result, _: _inverse(result.rows),  # MatrixInverse
    35: ONE,  # Modf
    46: _each(3),  # FMix: a + t (b - a)
    49: _each(6, 1),  # SmoothStep
    50: _each(2),  # Fma
    66: lambda _, vector: Cost(_dot(vector.rows), 1),  # Length
    67: lambda _, vector: Cost(vector.rows + _dot(vector.rows), 1),  # Distance
    68: lambda *_: Cost(9),  # Cross
    69: lambda result, _: Cost(_dot(result.rows) + result.rows, 1),  # Normalize
    70: lambda result, _: Cost(_dot(result.rows)),  # FaceForward
    71: lambda result, _: Cost(_dot(result.rows) + 1 + 2 * result.rows),  # Reflect
    72: lambda result, _: Cost(_dot(result.rows) + 7 + 3 * result.rows, 1),  # Refract
}
"""By number of the instruction in GLSL.std.450; all others cost nothing."""
