"""`deltalight calibrate`: lenses, transforms between sensors, response and paper."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from deltalight.protocol.errors import DeltalightError

if TYPE_CHECKING:
    from deltalight.sensor_node.calibration.lens_calibration import LensKind
    from deltalight.sensor_node.calibration.picture_sources import Eye

calibrate = typer.Typer(
    no_args_is_help=True,
    help="Calibrate lenses, sensor positions, the camera's response and the board's paper.",
)

Source = Annotated[
    str,
    typer.Argument(
        help="Folder of pictures, pattern (shots/*.jpg), dataset folder, .mcap recording or camera (uvc:0)."
    ),
]
RecordedSource = Annotated[Path, typer.Argument(help="Dataset folder or .mcap recording.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for calibration/*.yaml; created if missing.")]
TargetOption = Annotated[
    str | None,
    typer.Option(
        help="board.yaml, or chessboard:COLUMNSxROWS:SQUARE (inner corners, metres); default: the source's board."
    ),
]
Views = Annotated[int, typer.Option(min=8, max=200, help="Number of views to take with a live camera.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an older result.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]


class Model(StrEnum):
    """Lens model of a fish-eye."""

    EQUIDISTANT = "equidistant"
    OCAM = "ocam"


class Transform(StrEnum):
    """A transform of extrinsics.yaml."""

    RGB_FROM_FISHEYE = "rgb_from_fisheye"
    WORLD_FROM_FISHEYE = "world_from_fisheye"
    DEPTH_FROM_RGB = "depth_from_rgb"


class EyeOption(StrEnum):
    """A camera of the station."""

    RGB = "rgb"
    FISHEYE = "fisheye"


@calibrate.command()
def camera(
    source: Source,
    *,
    out: Out,
    target: TargetOption = None,
    coefficients: Annotated[
        int, typer.Option(help="Coefficients of the plumb_bob lens: 5, or 8 for wide lenses.")
    ] = 5,
    views: Views = 25,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate the lens of a colour camera: writes OUT/calibration/rgb.yaml."""
    if coefficients not in (5, 8):
        raise DeltalightError(
            f"--coefficients {coefficients} is not a form of the plumb_bob lens; give 5 or 8."
        )
    kind: LensKind = "plumb_bob_5" if coefficients == 5 else "plumb_bob_8"
    _calibrate_lens(_LensJob(source, "rgb", kind, out, target, views), force=force, as_json=as_json)


@calibrate.command()
def fisheye(
    source: Source,
    *,
    out: Out,
    target: TargetOption = None,
    model: Annotated[Model, typer.Option(help="Lens model.")] = Model.EQUIDISTANT,
    views: Views = 25,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate the lens of a fish-eye camera: writes OUT/calibration/fisheye.yaml."""
    _calibrate_lens(
        _LensJob(source, "fisheye", model.value, out, target, views), force=force, as_json=as_json
    )


class _LensJob(NamedTuple):
    """The options of `camera` and `fisheye`."""

    source: str
    eye: "Eye"
    kind: "LensKind"
    out: Path
    target: str | None
    views: int


def _calibrate_lens(job: _LensJob, *, force: bool, as_json: bool) -> None:
    from deltalight.sensor_node.calibration.lens_calibration import calibrate_lens, require_good
    from deltalight.sensor_node.calibration.picture_sources import open_series
    from deltalight.sensor_node.calibration.targets import parse_target
    from deltalight.services.calibration import (
        Watch,
        lens_report,
        print_lens_report,
        result_path,
        save_lens,
        save_pictures,
    )

    path = result_path(job.out, f"{job.eye}.yaml", force=force)
    series = open_series(job.source, job.eye)
    target = parse_target(job.target, series.board, (series.folder, job.out))
    result = calibrate_lens(Watch(series.total).collect(series, target, job.views), target, job.kind)
    pictures = save_pictures(result, path.with_suffix(""))
    if not as_json:
        print_lens_report(result)
    require_good(result)
    save_lens(path, result.fit.lens)
    if as_json:
        typer.echo(json.dumps({**lens_report(result), "written": [str(path), *pictures]}, indent=2))
    else:
        typer.echo(f"written to {path}, pictures beside it")


@calibrate.command()
def extrinsics(
    source: RecordedSource,
    *,
    what: Annotated[
        Transform,
        typer.Option(
            help="Transform to find; world_from_fisheye is for a fish-eye camera that stands still."
        ),
    ],
    out: Out,
    target: Annotated[Path | None, typer.Option(help="board.yaml; default: the source's board.")] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find where a sensor is: writes a transform to OUT/calibration/extrinsics.yaml."""
    from deltalight.services.calibration_extrinsics import ExtrinsicsJob, find_transform

    figures = find_transform(ExtrinsicsJob(source, what.value, out, target), force=force)
    _print_figures(figures, as_json=as_json)


@calibrate.command()
def photometric(
    source: Annotated[
        Path, typer.Argument(help="Folder with an exposure bracket; with --card a dataset folder or .mcap.")
    ],
    *,
    out: Out,
    eye: Annotated[EyeOption, typer.Option(help="Which camera took the bracket.")] = EyeOption.RGB,
    card: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,X1,Y1",
            help="Grey card on the board: two opposite corners in metres in the board's frame. Finds the paper's"
            " albedo instead of the response.",
        ),
    ] = None,
    card_albedo: Annotated[float, typer.Option(help="Albedo of the grey card.")] = 0.18,
    target: Annotated[
        Path | None, typer.Option(help="With --card: board.yaml; default: the source's board.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find a camera's response from an exposure bracket, or with --card the albedo of the board's paper."""
    from deltalight.services.calibration_photometric import find_paper_albedo, find_response

    if card is None:
        figures = find_response(source, eye.value, out, force=force)
    else:
        figures = find_paper_albedo(source, (card, card_albedo), out, target, force=force)
    _print_figures(figures, as_json=as_json)


def _print_figures(figures: dict[str, Any], *, as_json: bool) -> None:
    """Prints figures as JSON, or one per line."""
    if as_json:
        typer.echo(json.dumps(figures, indent=2))
        return
    for name, value in figures.items():
        typer.echo(f"{name.replace('_', ' ')}: {value}")
