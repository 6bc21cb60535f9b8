"""Common parts of the `deltalight calibrate` commands: collecting with progress, reports, results on disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import replacing, write_png
from deltalight.services.files import make_output_folder, require_output_folder

if TYPE_CHECKING:
    from deltalight.protocol.camera_model import CameraModel
    from deltalight.protocol.fisheye_lens import FisheyeLens
    from deltalight.sensor_node.calibration.lens_calibration import LensResult
    from deltalight.sensor_node.calibration.picture_sources import Series
    from deltalight.sensor_node.calibration.targets import Target
    from deltalight.sensor_node.calibration.views import ViewCollector


def result_path(folder: Path, name: str, *, force: bool) -> Path:
    """Returns the path of a new file in `folder`/calibration, checked before any work is done.

    Raises:
        DeltalightError: the file exists and `force` is not given, or the folder cannot be written.
    """
    path = folder / "calibration" / name
    if path.exists() and not force:
        raise DeltalightError(f"{path} already exists; overwrite it with --force or name another --out.")
    require_output_folder(path.parent)
    return path


def write_result(path: Path, save: Callable[[Path], None]) -> None:
    """Lets `save` write a temporary file, then moves it into place; makes its folder if missing."""
    make_output_folder(path.parent)
    with replacing(path) as temporary:
        save(temporary)


@dataclass
class Watch:
    """Shows the progress through a series on stderr: a bar for files, a line per view of a live camera."""

    total: int | None
    console: Console = field(default_factory=lambda: Console(stderr=True, soft_wrap=True))

    def collect(self, series: "Series", target: "Target", enough: int) -> "ViewCollector":
        """Collects the views of a series."""
        from deltalight.sensor_node.calibration.picture_sources import collect_views

        if self.total is None:
            return collect_views(series, target, enough=enough, tell=partial(self._tell_live, enough=enough))
        columns = (TextColumn("looking for the target"), BarColumn(), MofNCompleteColumn())
        hidden = not self.console.is_terminal  # it would leave an empty line in a file
        with Progress(*columns, console=self.console, transient=True, disable=hidden) as progress:
            task = progress.add_task("pictures", total=self.total)
            return collect_views(series, target, enough=enough, tell=lambda *_: progress.advance(task))

    def _tell_live(self, collected: "ViewCollector", taken: bool, *, enough: int) -> None:
        from deltalight.sensor_node.calibration.coverage import measure_coverage

        if collected.seen == 1:  # not before: a camera may be missing
            self.console.print(
                f"Show the target from all sides and hold it still each time; {enough} views are needed,"
                " or press Ctrl-C to stop early."
            )
        if taken:
            coverage = measure_coverage(collected.views, collected.size)
            self.console.print(
                f"view {len(collected.views)}: {100 * coverage.fraction:.0f} % of the picture seen\n"
                f"{coverage.text()}",
                markup=False,
                highlight=False,
            )


def save_lens(path: Path, lens: "CameraModel | FisheyeLens") -> None:
    """Writes rgb.yaml or fisheye.yaml; response and vignetting of an older fisheye.yaml stay."""
    from deltalight.protocol.camera_model import CameraModel, save_camera_yaml
    from deltalight.protocol.fisheye_lens import FisheyeCalibration, load_fisheye_yaml, save_fisheye_yaml

    if isinstance(lens, CameraModel):
        write_result(path, lambda aside: save_camera_yaml(aside, lens, path.stem))
        return
    calibration = FisheyeCalibration(lens)
    if path.exists():
        calibration = replace(load_fisheye_yaml(path), lens=lens)
    write_result(path, lambda aside: save_fisheye_yaml(aside, calibration))


def save_pictures(result: "LensResult", stem: Path) -> list[str]:
    """Writes `<stem>_coverage.png` and `<stem>_residuals.png`; returns their names."""
    from deltalight.sensor_node.calibration.coverage import draw_coverage, draw_misses

    pictures = {
        "coverage": draw_coverage(result.brightest, result.fit, result.coverage),
        "residuals": draw_misses(result.brightest, result.fit),
    }
    make_output_folder(stem.parent)
    paths = [stem.with_name(f"{stem.name}_{name}.png") for name in pictures]
    for path, picture in zip(paths, pictures.values(), strict=True):
        write_png(path, picture)
    return [str(path) for path in paths]


def lens_report(result: "LensResult") -> dict[str, Any]:
    """Returns the figures of a lens calibration as plain values."""
    fit = result.fit
    return {
        "pictures": result.pictures,
        "views": len(fit.views),
        "rms_px": round(fit.rms_px, 4),
        "focal_uncertainty_percent": round(100 * fit.focal_fraction, 3),
        "tilt_spread_deg": round(fit.tilt_spread_deg, 1),
        "coverage_percent": round(100 * result.coverage.fraction, 1),
        "per_view": [
            {"name": view.name, "points": len(view.points), "rms_px": round(float(error), 4)}
            for view, error in zip(fit.views, fit.view_rms_px, strict=True)
        ],
        "refused": [{"name": name, "reason": reason} for name, reason in fit.refused],
        "refused_points": fit.refused_points,
        "lens": fit.lens.to_dict(),
    }


def print_lens_report(result: "LensResult") -> None:
    """Prints the views, what was left out, the coverage and the figures."""
    report, console = lens_report(result), Console(soft_wrap=True, highlight=False, markup=False)
    rows = [(view["name"], str(view["points"]), f"{view['rms_px']:.2f}") for view in report["per_view"]]
    print_table(console, ("view", "points", "rms px"), rows)
    for view in report["refused"]:
        console.print(f"left out: {view['name']} {view['reason']}")
    if report["refused_points"]:
        console.print(f"left out: {report['refused_points']} single points that are not the target's")
    console.print("points seen in each part of the picture (9 = nine or more, . = none):")
    console.print(result.coverage.text())
    console.print(
        f"{report['views']} views of {report['pictures']} pictures, {report['rms_px']:.3f} px rms, focal length"
        f" within {report['focal_uncertainty_percent']:.2f} %, {report['coverage_percent']:.0f} % of the picture seen"
    )


def print_table(console: Console, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Prints rows under headings, with numbers right-aligned."""
    table = Table(box=None)
    for column, heading in enumerate(headings):
        table.add_column(heading, justify="left" if column == 0 else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)
