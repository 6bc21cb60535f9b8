"""The marker board: its description (board.yaml of docs/formats.md 1) and its geometry in the world frame."""

from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
import yaml
from jaxtyping import Float64, UInt8
from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    StringConstraints,
    Tag,
    field_validator,
    model_serializer,
    model_validator,
)

from deltalight.protocol.documents import StrictModel, nearest, read_mapping, validate
from deltalight.protocol.errors import DeltalightError

ASSUMED_PAPER_ALBEDO = 0.8
# Patches keep this fraction of a white gap's width away from the black on either side, where blur mixes both.
PATCH_INSET = 0.2
Length = Annotated[float, Field(gt=0, lt=10)]
Margin = Annotated[float, Field(ge=0, lt=10)]


class CustomDictionary(StrictModel):
    """A dictionary of one marker that OpenCV does not know (an extension of docs/formats.md 1, for type `single`).

    In board.yaml either `{marker_size, border_bits, bits}` or `{marker_size, border_bits, image}`: `bits`
    holds the code's cells row by row, 0 = black, 1 = white, without the border; `image` is a picture of the
    marker with its black border, cropped to it, beside board.yaml, from which the cells are read.
    """

    marker_size: int = Field(ge=3, le=12, description="Cells along an edge of the code, without its border.")
    border_bits: int = Field(default=1, ge=1, le=8, description="Width of the black border in cells.")
    bits: Annotated[str, StringConstraints(pattern="^[01]+$")] = Field(
        description="Cells row by row, 0 = black, 1 = white."
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.bits) != self.marker_size**2:
            raise ValueError(
                f"bits must hold marker_size^2 = {self.marker_size**2} cells, not {len(self.bits)}"
            )
        return self

    def cells(self) -> UInt8[np.ndarray, "n n"]:
        """Returns the code's cells, 0 = black, 1 = white."""
        return np.array([int(bit) for bit in self.bits], np.uint8).reshape(self.marker_size, self.marker_size)


class LampMarker(StrictModel):
    """A marker of the board's dictionary that is fixed to a lamp and moves with it.

    Its frame has the origin in the marker's middle, +x right, +y up the marker, +z out of the paper.
    """

    id: int = Field(ge=0, description="Id in the board's dictionary; not one of the board's own.")
    marker_length_m: Length = Field(description="Outer edge of the marker's black border, in metres.")

    def corner_points(self) -> Float64[np.ndarray, "4 3"]:
        """Returns the corners in the marker's frame, in OpenCV's order (top-left, then clockwise)."""
        half = self.marker_length_m / 2
        return _rectangle(-half, half, self.marker_length_m, self.marker_length_m)


class GreyCard(StrictModel):
    """A flat card of known albedo in the sheet's plane: on the sheet or beside it."""

    center_m: tuple[float, float] = Field(description="Middle (x, y) in world coordinates, metres.")
    size_m: tuple[Length, Length] = Field(description="Edges along x and y before the turn, metres.")
    rotation_deg: float = Field(
        default=0.0, ge=-180, le=180, description="Turn from x towards y about the middle, degrees."
    )
    albedo: float = Field(gt=0, le=1, description="Diffuse albedo; 0.18 for the usual grey card.")

    def outline(self) -> Float64[np.ndarray, "4 3"]:
        """Returns the corners in world coordinates."""
        width, height = self.size_m
        angle = np.radians(self.rotation_deg)
        across, along = (
            np.array([np.cos(angle), np.sin(angle), 0]),
            np.array([-np.sin(angle), np.cos(angle), 0]),
        )
        corners = _rectangle(-width / 2, height / 2, width, height)
        return np.asarray((*self.center_m, 0.0) + corners[:, :1] * across + corners[:, 1:2] * along)


def _dictionary_kind(value: object) -> str:
    return "name" if isinstance(value, str) else "custom"


MarkerDictionary = Annotated[
    Annotated[str, Tag("name")] | Annotated[CustomDictionary, Tag("custom")], Discriminator(_dictionary_kind)
]


class BoardSpec(StrictModel):
    """A printed board of square markers (board.yaml of docs/formats.md 1).

    World coordinates are those of docs/formats.md 3: origin at the top-left corner of the first marker, +x right
    along the rows, +y up the sheet (rows lie at y <= 0), +z out of the paper; all in metres. For `charuco`, `rows`
    and `columns` count squares, and a square's edge is marker_length_m + separation_m. For `single`, separation_m is
    the width of the white margin around the marker.

    `dictionary` is OpenCV's name of a dictionary, or, for `single`, a `CustomDictionary` of one marker: a mapping
    `{marker_size: 6, border_bits: 3, image: marker.png}` or `{marker_size, border_bits, bits: "0101.."}`.
    """

    type: Literal["aruco_grid", "charuco", "apriltag_grid", "single"]
    dictionary: MarkerDictionary
    marker_length_m: Length = Field(description="Outer edge of a marker's black border, in metres.")
    separation_m: float = Field(
        default=0.0, ge=0, lt=10, description="White gap between neighbouring markers, in metres."
    )
    rows: int = Field(default=1, ge=1, le=100)
    columns: int = Field(default=1, ge=1, le=100)
    first_id: int | None = Field(
        default=None, ge=0, description="Id of the first marker; the others follow row by row."
    )
    ids: tuple[int, ...] | None = Field(
        default=None, description="Ids of all markers, row by row; in place of first_id."
    )
    white_albedo: float | None = Field(
        default=None, gt=0, le=1, description="Diffuse albedo of the paper; null = unknown, 0.8 is assumed."
    )
    margins_m: tuple[Margin, Margin, Margin, Margin] | None = Field(
        default=None,
        description="Paper beyond the print: left, top, right, bottom, metres; null = not known.",
    )
    grey_cards: tuple[GreyCard, ...] = Field(
        default=(), max_length=16, description="Cards of known albedo that lie in the sheet's plane."
    )
    lamp_markers: tuple[LampMarker, ...] = Field(
        default=(), max_length=64, description="Markers of the same dictionary that are fixed to lamps."
    )

    @field_validator("dictionary")
    @classmethod
    def _check_dictionary(cls, value: str | CustomDictionary) -> str | CustomDictionary:
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if isinstance(value, str) and value not in known:
            hint = nearest(value, known)
            raise ValueError(f"there is no such dictionary in OpenCV, the nearest name is {hint or known[0]}")
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.first_id is not None and self.ids is not None:
            raise ValueError("give either first_id or ids, not both")
        if self.type == "single" and (self.rows, self.columns) != (1, 1):
            raise ValueError("a board of type single has one row and one column")
        if self.type != "single" and isinstance(self.dictionary, CustomDictionary):
            raise ValueError("a custom dictionary has one marker, so the board's type must be single")
        if self.type == "charuco" and (self.separation_m <= 0 or self.rows < 2 or self.columns < 2):
            raise ValueError("a charuco board needs 2 rows, 2 columns and a separation_m above 0")
        self._check_ids()
        return self

    def _check_ids(self) -> None:
        count, ids = len(self._cells), self.marker_ids
        if len(ids) != count or len(set(ids)) != count:
            raise ValueError(f"ids must name {count} different markers, row by row")
        size = len(self.opencv_dictionary().bytesList)
        if min(ids) < 0 or max(ids) >= size:
            raise ValueError(f"the dictionary has {size} markers, so ids go from 0 to {size - 1}")
        self._check_lamp_ids(size)

    def _check_lamp_ids(self, size: int) -> None:
        lamps = [lamp.id for lamp in self.lamp_markers]
        for lamp in lamps:
            if lamp in self.marker_ids:
                raise ValueError(
                    f"marker {lamp} of lamp_markers is also on the board; give the lamp an id of its own"
                )
        if len(set(lamps)) != len(lamps):
            raise ValueError("lamp_markers name a marker twice; give each lamp an id of its own")
        if lamps and max(lamps) >= size:
            raise ValueError(f"the dictionary has {size} markers, so lamp_markers go from 0 to {size - 1}")

    @model_serializer(mode="wrap")
    def _without_what_is_not_given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leaves out margins, cards and lamps of a board without: it serialises as before these existed."""
        return {
            key: value
            for key, value in dump(self).items()
            if value not in ((), []) and (key, value) != ("margins_m", None)
        }

    @property
    def paper_albedo(self) -> float:
        """Albedo of the white paper: as given, or 0.8 if unknown."""
        return ASSUMED_PAPER_ALBEDO if self.white_albedo is None else self.white_albedo

    @property
    def border_bits(self) -> int:
        """Width of the markers' black border in cells (OpenCV's `markerBorderBits`)."""
        return self.dictionary.border_bits if isinstance(self.dictionary, CustomDictionary) else 1

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Ids of the markers, row by row."""
        first = self.first_id or 0
        return self.ids if self.ids is not None else tuple(range(first, first + len(self._cells)))

    @property
    def _pitch(self) -> float:
        return self.marker_length_m + self.separation_m

    @cached_property
    def _cells(self) -> list[tuple[int, int]]:
        """Returns (row, column) of every marker, in the order of the ids."""
        every = [(row, column) for row in range(self.rows) for column in range(self.columns)]
        # OpenCV's ChArUco boards (from 4.6 on) start with a black square.
        return [cell for cell in every if self.type != "charuco" or sum(cell) % 2 == 1]

    def opencv_dictionary(self) -> Any:  # noqa: ANN401 - cv2 has no types
        """Returns the `cv2.aruco.Dictionary` that holds the board's markers."""
        if isinstance(self.dictionary, str):
            return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        cells = self.dictionary.cells()
        return cv2.aruco.Dictionary(cv2.aruco.Dictionary.getByteListFromBits(cells), len(cells), 0)

    def _marker_corner(self, row: int, column: int) -> tuple[float, float]:
        """Returns the top-left corner (x, y) of the marker in a cell."""
        first_row, first_column = self._cells[0]
        return (column - first_column) * self._pitch, -(row - first_row) * self._pitch

    def corner_points(self) -> dict[int, Float64[np.ndarray, "4 3"]]:
        """Returns the corners of every marker by id, in OpenCV's order (top-left, then clockwise)."""
        length = self.marker_length_m
        quads = [_rectangle(*self._marker_corner(*cell), length, length) for cell in self._cells]
        return dict(zip(self.marker_ids, quads, strict=True))

    def chessboard_corners(self) -> Float64[np.ndarray, "n 3"]:
        """Returns the inner corners of a `charuco` board, row by row (OpenCV's ids); else none."""
        if self.type != "charuco":
            return np.zeros((0, 3))
        left, top = self._first_square()
        grid = [(row, column) for row in range(1, self.rows) for column in range(1, self.columns)]
        return np.array([(left + column * self._pitch, top - row * self._pitch, 0.0) for row, column in grid])

    def _first_square(self) -> tuple[float, float]:
        """Returns the top-left corner (x, y) of the square in row 0, column 0."""
        x, y = self._marker_corner(0, 0)
        return x - self.separation_m / 2, y + self.separation_m / 2

    def sheet_outline(self) -> Float64[np.ndarray, "4 3"]:
        """Returns the corners of the printed area (top-left, then clockwise), without outer margin."""
        if self.type == "charuco":
            return _rectangle(*self._first_square(), self.columns * self._pitch, self.rows * self._pitch)
        gap = self.separation_m
        return _rectangle(0.0, 0.0, self.columns * self._pitch - gap, self.rows * self._pitch - gap)

    def paper_outline(self) -> Float64[np.ndarray, "4 3"]:
        """Returns the corners of the paper (as in `sheet_outline`).

        Where `margins_m` does not give them, only the margin is certain that markers need to be found: one cell, and
        separation_m around a single marker; a chessboard needs none.
        """
        left, top, right, bottom = self.margins_m or (self._least_margin,) * 4
        outward = np.array([(-left, top, 0), (right, top, 0), (right, -bottom, 0), (-left, -bottom, 0)])
        return np.asarray(self.sheet_outline() + outward)

    @property
    def _least_margin(self) -> float:
        if self.type == "charuco":
            return 0.0
        cell = self.marker_length_m / float(self.opencv_dictionary().markerSize + 2 * self.border_bits)
        return max(cell, self.separation_m) if self.type == "single" else cell

    def paper_patches(self) -> Float64[np.ndarray, "n 4 3"]:
        """Returns quads of white paper between the markers (corners as in `sheet_outline`).

        Grids: the gaps between two neighbouring markers, without the crossings (some grids print squares
        there). Others: the white margin on the four sides of each marker.
        """
        if self.separation_m == 0:
            return np.zeros((0, 4, 3))
        if self.type in ("charuco", "single"):
            width = self.separation_m / (2 if self.type == "charuco" else 1)
            quads = [
                quad for cell in self._cells for quad in self._margin(*self._marker_corner(*cell), width)
            ]
        else:
            quads = [quad for cell in self._cells for quad in self._gaps(*cell)]
        return np.array(quads).reshape(-1, 4, 3)

    def _margin(self, x: float, y: float, width: float) -> list[Float64[np.ndarray, "4 3"]]:
        length, inset = self.marker_length_m, PATCH_INSET * width
        thin = width - 2 * inset
        across = [(x, y + width - inset), (x, y - length - inset)]
        along = [(x - width + inset, y), (x + length + inset, y)]
        return [_rectangle(*corner, length, thin) for corner in across] + [
            _rectangle(*corner, thin, length) for corner in along
        ]

    def _gaps(self, row: int, column: int) -> list[Float64[np.ndarray, "4 3"]]:
        """Returns the gaps to the right of and below the marker in a cell, where it has a neighbour."""
        x, y = self._marker_corner(row, column)
        length, inset = self.marker_length_m, PATCH_INSET * self.separation_m
        thin, quads = self.separation_m - 2 * inset, []
        if column + 1 < self.columns:
            quads.append(_rectangle(x + length + inset, y - inset, thin, length - 2 * inset))
        if row + 1 < self.rows:
            quads.append(_rectangle(x + inset, y - length - inset, length - 2 * inset, thin))
        return quads


def _rectangle(left: float, top: float, width: float, height: float) -> Float64[np.ndarray, "4 3"]:
    """Returns the corners from the top-left one on, clockwise as seen from in front of the paper (y is up)."""
    right, bottom = left + width, top - height
    return np.array([(left, top, 0.0), (right, top, 0.0), (right, bottom, 0.0), (left, bottom, 0.0)])


def load_board_yaml(path: Path) -> BoardSpec:
    """Reads a board description; a custom marker's picture is read from beside it and converted to bits.

    Raises:
        DeltalightError: the file, a key or the marker's picture is missing or wrong.
    """
    data = read_mapping(path)
    dictionary = data.get("dictionary")
    if isinstance(dictionary, dict) and "image" in dictionary:
        data["dictionary"] = _with_bits(dictionary, path.parent)
    return validate(BoardSpec, data, str(path))


def save_board_yaml(path: Path, board: BoardSpec) -> None:
    """Writes a board description in the form that `load_board_yaml` reads."""
    data = board.model_dump(mode="json", exclude_none=True)
    path.write_text(yaml.safe_dump(data, sort_keys=False, default_flow_style=None), encoding="utf-8")


def _with_bits(dictionary: dict[str, Any], folder: Path) -> dict[str, Any]:
    image = folder / str(dictionary["image"])
    picture = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE) if image.is_file() else None
    if picture is None:
        raise DeltalightError(
            f"the marker's picture {image} cannot be read; give a picture beside board.yaml."
        )
    size, border = dictionary.get("marker_size"), dictionary.get("border_bits", 1)
    if not (isinstance(size, int) and isinstance(border, int) and 3 <= size <= 12 and 1 <= border <= 8):
        raise DeltalightError(
            f"the marker of {image} needs marker_size 3..12 and border_bits 1..8; correct board.yaml."
        )
    count = size + 2 * border
    white = cv2.resize(picture, (count, count), interpolation=cv2.INTER_AREA) > 127
    code = white[border:-border, border:-border]
    if white.sum() != code.sum():
        raise DeltalightError(
            f"{image} has no black border of {border} cells around {size}x{size}; correct board.yaml."
        )
    others = {key: value for key, value in dictionary.items() if key != "image"}
    return {**others, "bits": "".join("1" if cell else "0" for cell in code.ravel())}
