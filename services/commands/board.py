"""`deltalight board`: a marker board to print, and its board.yaml."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from deltalight.protocol.errors import DeltalightError

if TYPE_CHECKING:
    from deltalight.protocol.board import BoardSpec

LONGEST_MM = 9_999.0  # board.yaml takes lengths below 10 m


class BoardType(StrEnum):
    """Kinds of boards that are printed."""

    ARUCO_GRID = "aruco_grid"
    CHARUCO = "charuco"
    APRILTAG_GRID = "apriltag_grid"


class Paper(StrEnum):
    """Paper sizes."""

    A4 = "a4"
    A3 = "a3"
    LETTER = "letter"


class _Defaults(NamedTuple):
    """Sizes with which a board of a type fills A4 well."""

    dictionary: str
    rows: int
    columns: int
    marker_mm: float
    separation_mm: float


DEFAULTS = {
    BoardType.ARUCO_GRID: _Defaults("DICT_4X4_50", 3, 4, 40.0, 10.0),
    BoardType.APRILTAG_GRID: _Defaults("DICT_APRILTAG_36h11", 3, 4, 40.0, 10.0),
    BoardType.CHARUCO: _Defaults("DICT_5X5_50", 5, 7, 24.0, 8.0),
}


def board(
    *,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="PDF file; a .yaml file of the same name is written beside it."),
    ],
    kind: Annotated[BoardType, typer.Option("--type", help="Kind of board.")] = BoardType.ARUCO_GRID,
    paper: Annotated[
        Paper, typer.Option(help="Paper size; it is turned if the board only fits that way.")
    ] = Paper.A4,
    rows: Annotated[
        int | None, typer.Option(min=1, max=100, help="Rows of markers (for charuco: of squares).")
    ] = None,
    columns: Annotated[
        int | None, typer.Option(min=1, max=100, help="Columns of markers (for charuco: of squares).")
    ] = None,
    marker_mm: Annotated[
        float | None, typer.Option(min=1, max=LONGEST_MM, help="Outer edge of a marker, mm.")
    ] = None,
    separation_mm: Annotated[
        float | None,
        typer.Option(
            min=0, max=LONGEST_MM, help="White gap between markers, mm (charuco: square less marker)."
        ),
    ] = None,
    dictionary: Annotated[str | None, typer.Option(help="OpenCV's name of the dictionary.")] = None,
    first_id: Annotated[int, typer.Option(min=0, help="Id of the first marker.")] = 0,
    lamp_marker: Annotated[
        list[int] | None,
        typer.Option(
            help="Id of a marker to fix to a lamp, on a page of its own; may be given more than once."
        ),
    ] = None,
    lamp_marker_mm: Annotated[
        float, typer.Option(min=1, max=LONGEST_MM, help="Outer edge of the lamps' markers, mm.")
    ] = 40.0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite older files.")] = False,
) -> None:
    """Write a marker board as a true-scale PDF, and its board.yaml."""
    from deltalight.protocol.board import save_board_yaml
    from deltalight.protocol.files import replacing
    from deltalight.services.board_pdf import choose_page, margins_m, write_board_pdf
    from deltalight.services.files import make_output_folder

    described = out.with_suffix(".yaml")
    if out.suffix.lower() != ".pdf":
        raise DeltalightError(f"'{out}' is not a PDF file; name one with --out, such as board.pdf.")
    for path in (out, described):
        if path.exists() and not force:
            raise DeltalightError(f"{path} already exists; overwrite it with --force or name another --out.")
    usual = DEFAULTS[kind]
    spec = _spec(
        kind,
        _Defaults(
            dictionary or usual.dictionary,
            rows or usual.rows,
            columns or usual.columns,
            usual.marker_mm if marker_mm is None else marker_mm,
            usual.separation_mm if separation_mm is None else separation_mm,
        ),
        first_id,
        [(name, lamp_marker_mm) for name in lamp_marker or ()],
    )
    spec = spec.replaced(margins_m=margins_m(spec, choose_page(spec, paper.value)))
    make_output_folder(out.parent)
    with replacing(out) as aside:
        write_board_pdf(aside, spec, paper.value)
    with replacing(described) as aside:
        save_board_yaml(aside, spec)
    typer.echo(f"written to {out} and {described}; print at 100 % and measure the ruler")


def _spec(kind: BoardType, size: _Defaults, first_id: int, lamps: list[tuple[int, float]]) -> "BoardSpec":
    from deltalight.protocol.board import BoardSpec
    from deltalight.protocol.documents import validate

    data = {
        "type": kind.value,
        "dictionary": size.dictionary,
        "marker_length_m": size.marker_mm / 1e3,
        "separation_m": size.separation_mm / 1e3,
        "rows": size.rows,
        "columns": size.columns,
        "first_id": first_id,
        "lamp_markers": [{"id": name, "marker_length_m": edge / 1e3} for name, edge in lamps],
    }
    return validate(BoardSpec, data, "the board")
