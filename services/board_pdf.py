"""Marker boards as true-scale vector PDF."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError, install_command

MM = 72 / 25.4  # PDF points
PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
# Printers leave a white rim of up to 6 mm; the axes are above the board, the ruler and the text below it.
SIDE_MM, TOP_MM, BOTTOM_MM = 12.0, 18.0, 28.0
RULER_MM = 100
# Distance of the axes from the print, so that they are not taken for an edge of a marker.
AXES_GAP_MM, AXES_MM = 5.0, 9.0
GREY, RED, GREEN, BLUE = (0.45,) * 3, (0.8, 0.1, 0.1), (0.1, 0.55, 0.1), (0.1, 0.2, 0.8)
SMALL = 7  # points


class Page(NamedTuple):
    """Paper in its orientation, in mm."""

    width: float
    height: float

    @property
    def room(self) -> tuple[float, float]:
        """Maximum width and height of a board."""
        return self.width - 2 * SIDE_MM, self.height - TOP_MM - BOTTOM_MM


def choose_page(board: BoardSpec, paper: str) -> Page:
    """Returns the paper in portrait, or in landscape if the board fits only so.

    Raises:
        DeltalightError: the board does not fit; the sentence names what does.
    """
    width, height = _board_mm(board)
    page = _fitting(width, height, paper)
    if page is not None:
        return page
    larger = [f"--paper {name}" for name in PAPERS_MM if _fitting(width, height, name)]
    scale = max(
        min(wide / width, high / height)
        for wide, high in (Page(*edges).room for edges in _orientations(paper))
    )
    # rounded down to tenths of a millimetre
    sizes = [np.floor(scale * 1e4 * edge) / 10 for edge in (board.marker_length_m, board.separation_m)]
    smaller = f"--marker-mm {sizes[0]:.1f} --separation-mm {sizes[1]:.1f}"
    raise DeltalightError(
        f"the board is {width:.0f} x {height:.0f} mm and does not fit on {paper}; print with "
        f"{' or '.join([smaller, *larger])}."
    )


def margins_m(board: BoardSpec, page: Page) -> tuple[float, float, float, float]:
    """Returns the paper left of, above, right of and below the printed board, in metres (BoardSpec.margins_m).

    In whole micrometres, so that board.yaml shows no digits that nobody measures.
    """
    width, height = _board_mm(board)
    left, top, right, bottom = (round(margin / 1e3, 6) for margin in _margins_mm(width, height, page))
    return left, top, right, bottom


def _margins_mm(width: float, height: float, page: Page) -> tuple[float, float, float, float]:
    side = (page.width - width) / 2
    return side, TOP_MM, side, page.height - TOP_MM - height


def _fitting(width: float, height: float, paper: str) -> Page | None:
    pages = [Page(*edges) for edges in _orientations(paper)]
    return next((page for page in pages if width <= page.room[0] and height <= page.room[1]), None)


def _orientations(paper: str) -> tuple[tuple[float, float], tuple[float, float]]:
    width, height = PAPERS_MM[paper]
    return (width, height), (height, width)


def _board_mm(board: BoardSpec) -> tuple[float, float]:
    outline = 1e3 * board.sheet_outline()
    width, height = np.ptp(outline, axis=0)[:2].tolist()
    return width, height


def write_board_pdf(path: Path, board: BoardSpec, paper: str) -> None:
    """Writes the board, and the markers for lamps on further pages.

    Raises:
        DeltalightError: the board or a lamp's marker does not fit on the paper, or reportlab is not installed.
    """
    try:
        from reportlab.pdfgen.canvas import Canvas
    except ImportError as error:
        raise DeltalightError(
            f"boards need the package reportlab: {install_command('reportlab')}."
        ) from error
    page = choose_page(board, paper)
    canvas = Canvas(str(path), pagesize=(page.width * MM, page.height * MM), invariant=True)
    canvas.setTitle(f"Deltalight marker board, {board.type}")
    sheet = _Sheet(canvas, board, page)
    sheet.draw()
    canvas.showPage()
    if board.lamp_markers:
        _draw_lamps(canvas, board, Page(*PAPERS_MM[paper]))
    canvas.save()


class _Sheet:
    """One page with the board in its middle; positions are world coordinates in mm."""

    def __init__(self, canvas: Any, board: BoardSpec, page: Page) -> None:  # noqa: ANN401 - reportlab has no types
        self._canvas, self._board, self._page = canvas, board, page
        outline = 1e3 * board.sheet_outline()
        self._left, self._top = outline[0, 0], outline[0, 1]
        self._right, self._bottom = outline[2, 0], outline[2, 1]

    def draw(self) -> None:
        page, canvas = self._page, self._canvas
        left, top, _, _ = _margins_mm(self._right - self._left, self._top - self._bottom, page)
        canvas.saveState()
        canvas.translate((left - self._left) * MM, (page.height - top - self._top) * MM)
        if self._board.type == "charuco":
            self._draw_squares()
        cells = marker_cells(self._board)
        for name, corners in self._board.corner_points().items():
            x, y = 1e3 * corners[0, :2]
            _draw_marker(canvas, cells[name], x, y, 1e3 * self._board.marker_length_m)
        self._draw_axes()
        canvas.restoreState()
        _draw_ruler(canvas, SIDE_MM, BOTTOM_MM - 12)
        self._write()

    def _draw_squares(self) -> None:
        """Draws the black squares of a chessboard, as one path so that they meet without a seam."""
        board, path = self._board, self._canvas.beginPath()
        edge = 1e3 * (board.marker_length_m + board.separation_m)
        for row in range(board.rows):
            for column in range(row % 2, board.columns, 2):
                path.rect(
                    (self._left + column * edge) * MM,
                    (self._top - (row + 1) * edge) * MM,
                    edge * MM,
                    edge * MM,
                )
        self._canvas.setFillGray(0)
        self._canvas.drawPath(path, stroke=0, fill=1)

    def _draw_axes(self) -> None:
        """Draws the world axes beside the print; the lines through them cross at the origin."""
        canvas, above, beside = self._canvas, self._top + AXES_GAP_MM, self._left - AXES_GAP_MM
        _draw_arrow(canvas, (0, above), (AXES_MM, above), RED, "x")
        _draw_arrow(canvas, (beside, 0), (beside, AXES_MM), GREEN, "y")
        canvas.setStrokeColorRGB(*BLUE)
        canvas.setFillColorRGB(*BLUE)
        x, y = beside - 4, 1.2
        canvas.circle(x * MM, y * MM, 1.2 * MM, stroke=1, fill=0)
        canvas.circle(x * MM, y * MM, 0.3 * MM, stroke=0, fill=1)
        canvas.setFont("Helvetica", SMALL)
        canvas.drawCentredString(x * MM, (y + 2) * MM, "z")

    def _write(self) -> None:
        board, canvas = self._board, self._canvas
        ids = board.marker_ids
        first, last = min(ids), max(ids)
        lines = (
            f"Deltalight board: {board.type}, {board.rows} rows x {board.columns} columns, {board.dictionary}, "
            f"ids {first} to {last}, markers {1e3 * board.marker_length_m:g} mm, "
            f"gaps {1e3 * board.separation_m:g} mm",
            f'Print at 100 % (not "fit to page") and measure the ruler. World origin: top-left corner of marker '
            f"{ids[0]}; x right, y up the sheet, z out of the paper.",
        )
        canvas.setFillColorRGB(*GREY)
        canvas.setFont("Helvetica", SMALL)
        for number, line in enumerate(lines):
            canvas.drawString(SIDE_MM * MM, (BOTTOM_MM - 17 - 3.5 * number) * MM, line)


def marker_cells(board: BoardSpec) -> dict[int, Bool[np.ndarray, "n n"]]:
    """Returns the white cells of the board's and its lamps' markers, with the black border, by id."""
    dictionary, border = board.opencv_dictionary(), board.border_bits
    size = dictionary.markerSize
    names = [*board.marker_ids, *(lamp.id for lamp in board.lamp_markers)]
    codes = {
        name: dictionary.getBitsFromByteList(dictionary.bytesList[name : name + 1], size) for name in names
    }
    return {name: np.pad(code.reshape(size, size) > 0, border) for name, code in codes.items()}


def _draw_marker(canvas: Any, cells: Bool[np.ndarray, "n n"], x: float, y: float, length: float) -> None:  # noqa: ANN401
    """Draws a marker with its top-left corner at (x, y) mm: a black square, its white cells as one path."""
    cell, path = length / len(cells), canvas.beginPath()
    for row, column in np.argwhere(cells).tolist():
        path.rect((x + column * cell) * MM, (y - (row + 1) * cell) * MM, cell * MM, cell * MM)
    canvas.setFillGray(0)
    canvas.rect(x * MM, (y - length) * MM, length * MM, length * MM, stroke=0, fill=1)
    canvas.setFillGray(1)
    canvas.drawPath(path, stroke=0, fill=1)


def _draw_arrow(
    canvas: Any,  # noqa: ANN401
    start: tuple[float, float],
    end: tuple[float, float],
    color: Sequence[float],
    name: str,
) -> None:
    along = np.subtract(end, start) / np.hypot(*np.subtract(end, start))
    across = np.array([-along[1], along[0]])
    tip, foot = np.array(end), np.array(end) - 2 * along
    canvas.setStrokeColorRGB(*color)
    canvas.setFillColorRGB(*color)
    canvas.setLineWidth(0.3 * MM)
    canvas.line(*(MM * np.array([*start, *foot])).tolist())
    path = canvas.beginPath()
    path.moveTo(*(MM * tip).tolist())
    for side in (0.8, -0.8):
        path.lineTo(*(MM * (foot + side * across)).tolist())
    path.close()
    canvas.drawPath(path, stroke=0, fill=1)
    canvas.setFont("Helvetica", SMALL)
    canvas.drawString(*(MM * (tip + 1 * along + (-0.8, -0.8))).tolist(), name)


def _draw_ruler(canvas: Any, x: float, y: float) -> None:  # noqa: ANN401
    canvas.setStrokeGray(0)
    canvas.setFillGray(0)
    canvas.setLineWidth(0.15 * MM)
    canvas.line(x * MM, y * MM, (x + RULER_MM) * MM, y * MM)
    for step in range(RULER_MM + 1):
        high = 4.0 if step % 10 == 0 else 2.8 if step % 5 == 0 else 1.8
        canvas.line((x + step) * MM, y * MM, (x + step) * MM, (y + high) * MM)
    canvas.setFont("Helvetica", SMALL)
    for step in range(0, RULER_MM + 1, 50):
        canvas.drawCentredString((x + step) * MM, (y + 4.8) * MM, f"{step} mm" if step else "0")


def _draw_lamps(canvas: Any, board: BoardSpec, page: Page) -> None:  # noqa: ANN401
    """Draws pages with the markers for lamps, row by row, each with a cutting line."""
    cells, size = marker_cells(board), board.opencv_dictionary().markerSize + 2 * board.border_bits
    x, y, row = SIDE_MM, page.height - TOP_MM, 0.0
    canvas.setPageSize((page.width * MM, page.height * MM))
    for lamp in board.lamp_markers:
        length = 1e3 * lamp.marker_length_m
        # A detector needs about a cell's width of white around a marker.
        rim = max(length / size, 4.0)
        edge = length + 2 * rim
        if edge > page.width - 2 * SIDE_MM:
            raise DeltalightError(
                f"the lamp's marker {lamp.id} of {length:.0f} mm does not fit on the paper; print it with "
                f"--lamp-marker-mm {np.floor((page.width - 2 * SIDE_MM) / (1 + 2 / size)):.0f} or smaller."
            )
        if x + edge > page.width - SIDE_MM:
            x, y, row = SIDE_MM, y - row - 8, 0.0
        if y - edge < BOTTOM_MM:
            _draw_ruler(canvas, SIDE_MM, BOTTOM_MM - 12)
            canvas.showPage()
            canvas.setPageSize((page.width * MM, page.height * MM))
            x, y, row = SIDE_MM, page.height - TOP_MM, 0.0
        _draw_marker(canvas, cells[lamp.id], x + rim, y - rim, length)
        canvas.setStrokeColorRGB(*GREY)
        canvas.setLineWidth(0.1 * MM)
        canvas.rect(x * MM, (y - edge) * MM, edge * MM, edge * MM, stroke=1, fill=0)
        canvas.setFillColorRGB(*GREY)
        canvas.setFont("Helvetica", SMALL)
        canvas.drawString(x * MM, (y - edge - 3.5) * MM, f"lamp marker {lamp.id}, {length:g} mm, up this way")
        x, row = x + edge + 6, max(row, edge)
    _draw_ruler(canvas, SIDE_MM, BOTTOM_MM - 12)
    canvas.showPage()
