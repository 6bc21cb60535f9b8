"""The camera's response from an exposure bracket, and the albedo of the board's paper from a grey card."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.board import BoardSpec, GreyCard
from deltalight.protocol.dataset_lists import read_list
from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.protocol.frames import LUMINANCE, SensorFrame, decode_lut
from deltalight.protocol.pictures import decode_rgb, read_bytes
from deltalight.sensor_node.calibration.picture_sources import PICTURE_SUFFIXES, Eye
from deltalight.sensor_node.fisheye.response import estimate_response
from deltalight.sensor_node.markers import BoardDetector

# Codes between which a pixel measures light: neither noise nor white.
USABLE_CODES = (20, 235)
# Exposures that disagree more about the light did not see the same scene, or their times are wrong.
MOST_RESIDUAL = 0.1
# EXIF: the block of camera settings, and in it the exposure time in seconds.
EXIF_BLOCK, EXPOSURE_TIME = 0x8769, 0x829A
# Points along an edge of a patch; the mean of 8 x 8 leaves a few tenths of a code of noise.
SAMPLES = 8
# The outer fraction of the card is left out on each side: blur mixes it with the paper.
CARD_INSET = 0.2
# Fewer gaps between markers do not determine how the light varies over the sheet.
LEAST_PATCHES = 4
WHITE_CODE = 250
# Range of white paper; outside it the card's position or reflectance is wrong.
POSSIBLE_ALBEDO = (0.4, 1.0)
MOST_SPREAD = 0.05


class Bracket(NamedTuple):
    """Pictures (RGB) of one still scene with their exposures in seconds."""

    pictures: tuple[UInt8[np.ndarray, "h w 3"], ...]
    exposures_s: tuple[float, ...]


class Response(NamedTuple):
    """Linear R G B of each code; `residual` is the relative disagreement (rms) of exposures about the light."""

    table: Float32[np.ndarray, "256 3"]
    pictures: int
    residual: float


class PaperAlbedo(NamedTuple):
    """Albedo of the paper.

    `spread` is its relative standard deviation over the pictures, `residual` the relative difference of the light on
    the paper from a smooth one.
    """

    albedo: float
    pictures: int
    spread: float
    residual: float


def read_bracket(folder: Path, eye: Eye) -> Bracket:
    """Reads a bracket: a folder whose rgb.txt or fisheye.txt has exposures (third column), or pictures with EXIF.

    Raises:
        DeltalightError: no such folder, or a picture without exposure.
    """
    if not folder.is_dir():
        raise DeltalightError(
            f"'{folder}' is not a folder; give one with the pictures of an exposure bracket."
        )
    listed = folder / f"{eye}.txt"
    if listed.is_file():
        exposures = {entry.path: entry.exposure_s for entry in read_list(listed)}
    else:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES)
        exposures = {path: _exif_exposure(path) for path in paths}
    lost = [path for path, exposure in exposures.items() if exposure is None]
    if lost or not exposures:
        name = lost[0] if lost else folder
        raise DeltalightError(
            f"{name} has no exposure; write it as the third column of {eye}.txt, or give pictures with EXIF data."
        )
    pictures = tuple(decode_rgb(read_bytes(path), str(path)) for path in exposures)
    return Bracket(pictures, tuple(float(exposure or 0) for exposure in exposures.values()))


def _exif_exposure(path: Path) -> float | None:
    try:
        from PIL import Image
    except ImportError as error:
        raise DeltalightError(
            f"reading exposures from EXIF needs Pillow: {install_command('pillow')}, or list them as third column of"
            " rgb.txt."
        ) from error
    with Image.open(path) as picture:
        exposure = picture.getexif().get_ifd(EXIF_BLOCK).get(EXPOSURE_TIME)
    return None if exposure is None else float(exposure)


def calibrate_response(bracket: Bracket) -> Response:
    """Returns the response of the camera that took a bracket.

    Raises:
        DeltalightError: there are too few exposures, or the pictures do not show the same light.
    """
    _require_exposures(bracket.exposures_s)
    table = estimate_response(bracket.pictures, bracket.exposures_s)
    residual = bracket_residual(bracket, table)
    if not residual <= MOST_RESIDUAL:
        raise DeltalightError(
            f"the exposures disagree about the light by {100 * residual:.0f} % (at most {100 * MOST_RESIDUAL:.0f} % "
            "is acceptable); keep camera and scene still, lock white balance and gain, and check the exposure times."
        )
    return Response(table, len(bracket.pictures), residual)


def _require_exposures(exposures_s: Sequence[float]) -> None:
    if len(set(exposures_s)) < 3 or max(exposures_s) < 4 * min(exposures_s):
        raise DeltalightError(
            f"a response needs three exposures over two stops or more, not {sorted(set(exposures_s))}; take the same "
            "scene at more exposures."
        )


def bracket_residual(bracket: Bracket, table: Float32[np.ndarray, "256 3"]) -> float:
    """Returns the rms relative difference between the light that the exposures of one pixel indicate."""
    squares, count = 0.0, 0
    logs = np.log(np.maximum(decode_lut(table), 1e-9))
    order = np.argsort(bracket.exposures_s)
    for first, second in pairwise(order):
        step = np.log(bracket.exposures_s[second] / bracket.exposures_s[first])
        for channel in range(3):
            codes = [bracket.pictures[which][..., channel] for which in (first, second)]
            usable = np.all([(USABLE_CODES[0] <= code) & (code <= USABLE_CODES[1]) for code in codes], axis=0)
            rise = logs[codes[1][usable], channel] - logs[codes[0][usable], channel] - step
            # half of a pair's variance is that of one exposure
            squares, count = squares + float(np.sum(rise**2)) / 2, count + rise.size
    return float(np.sqrt(squares / count)) if count else float("inf")


def paper_albedo(frames: Iterable[SensorFrame], board: BoardSpec, card: GreyCard) -> PaperAlbedo:
    """Returns the albedo of the board's paper, measured with a card of known albedo that lies on or beside it.

    Light varies over the sheet: the logarithm of the paper's light is fitted by a plane over the gaps between the
    markers, and compared with the card at the card's position.

    Args:
        frames: pictures of the board and the card, of a calibrated camera.
        board: the board.
        card: the card's position and albedo.

    Raises:
        DeltalightError: the board is not visible, the card or paper is clipped, or the result is impossible for
            paper.
    """
    detector: BoardDetector | None = None
    found: list[tuple[float, float]] = []
    for frame in frames:
        detector = detector or BoardDetector(board, frame.camera, frame.response)
        pose = detector.detect(frame.color)
        if pose is not None:
            found.append(_ratio(frame, pose.world_from_camera, board, card))
    if not found:
        raise DeltalightError(
            "no picture shows the board; take some with the whole board and the card in view."
        )
    albedos = np.array([ratio for ratio, _ in found]) * card.albedo
    albedo, spread = float(np.median(albedos)), float(np.std(albedos) / np.median(albedos))
    residual = float(np.median([misfit for _, misfit in found]))
    _check_paper(albedo, max(spread, residual))
    return PaperAlbedo(albedo, len(found), spread, residual)


def _check_paper(albedo: float, spread: float) -> None:
    low, high = POSSIBLE_ALBEDO
    if not low <= albedo <= high:
        raise DeltalightError(
            f"the paper would have an albedo of {albedo:.2f}, which no white paper has; check --card (metres in the "
            "board's frame), --card-albedo and the camera's response, and keep the card free of gloss."
        )
    if spread > MOST_SPREAD:
        raise DeltalightError(
            f"the paper's albedo differs by {100 * spread:.0f} % from place to place or picture to picture (at most "
            f"{100 * MOST_SPREAD:.0f} % is acceptable); light the sheet evenly and keep shadows and gloss away."
        )


def _ratio(
    frame: SensorFrame,
    world_from_camera: Float64[np.ndarray, "4 4"],
    board: BoardSpec,
    card: GreyCard,
) -> tuple[float, float]:
    """Returns the paper's light over the card's at the card's position, and the relative misfit of the plane."""
    outline = card.outline()
    card_light = _light(frame, world_from_camera, _shrunk(outline, CARD_INSET))
    patches = [patch for patch in board.paper_patches() if not _is_covered(patch, card)]
    lights = [_light(frame, world_from_camera, patch) for patch in patches]
    seen = [(patch.mean(axis=0), light) for patch, light in zip(patches, lights, strict=True) if light]
    if card_light is None or card_light <= 0 or len(seen) < LEAST_PATCHES:
        raise DeltalightError(
            "the card or the paper between the markers is not seen well: outside the picture, black or overexposed; "
            "take the whole sheet at an exposure at which the paper stays below white."
        )
    middle = outline.mean(axis=0)
    places = np.array([(1.0, *(place - middle)[:2]) for place, _ in seen])
    logs = np.log([light for _, light in seen])
    plane = np.linalg.lstsq(places, logs, rcond=None)[0]
    misfit = float(np.sqrt(np.mean((places @ plane - logs) ** 2)))
    return float(np.exp(plane[0]) / card_light), misfit


def _light(
    frame: SensorFrame, world_from_camera: Float64[np.ndarray, "4 4"], quad: Float64[np.ndarray, "4 3"]
) -> float | None:
    """Returns the mean linear luminance of a quad on the sheet; None if it leaves the picture or is clipped."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    s, t = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps))
    points = quad[0] + s * (quad[1] - quad[0]) + t * (quad[3] - quad[0])
    local = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    pixels = frame.camera.project(local)
    columns, rows = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).T
    inside = (columns >= 0) & (columns < frame.camera.width) & (rows >= 0) & (rows < frame.camera.height)
    if not inside.all():
        return None
    codes = frame.color[rows, columns]
    if codes.max() >= WHITE_CODE:
        return None
    table = decode_lut(frame.response)
    light = np.stack([table[codes[:, channel], channel] for channel in range(3)], axis=-1)
    return float((light @ LUMINANCE).mean())


def _shrunk(quad: Float64[np.ndarray, "4 3"], fraction: float) -> Float64[np.ndarray, "4 3"]:
    return np.asarray(quad + (quad.mean(axis=0) - quad) * 2 * fraction)


def _is_covered(patch: Float64[np.ndarray, "4 3"], card: GreyCard) -> bool:
    """Whether the card may cover a part of a patch (compared as boxes in the card's axes)."""
    outline = card.outline()
    axes = np.stack([outline[1] - outline[0], outline[0] - outline[3]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    theirs, ours = ((quad - outline.mean(axis=0)) @ axes.T for quad in (patch, outline))
    return bool(np.all((theirs.min(axis=0) <= ours.max(axis=0)) & (theirs.max(axis=0) >= ours.min(axis=0))))


def parse_card(text: str, albedo: float) -> GreyCard:
    """Returns the card described by `x0,y0,x1,y1` (two opposite corners, metres in the board's frame).

    Raises:
        DeltalightError: not four numbers, no area, or no valid albedo.
    """
    try:
        x0, y0, x1, y1 = (float(word) for word in text.split(","))
        size = (abs(x1 - x0), abs(y1 - y0))
        return GreyCard(center_m=((x0 + x1) / 2, (y0 + y1) / 2), size_m=size, albedo=albedo)
    except ValueError as error:
        raise DeltalightError(
            f"--card {text} with --card-albedo {albedo} is not a card; write two opposite corners x0,y0,x1,y1 in "
            "metres in the board's frame (+x right, +y up from the first marker's top-left corner), and an albedo"
            " above 0 and up to 1."
        ) from error
