"""`deltalight calibrate extrinsics`: one transform of calibration/extrinsics.yaml from a recording."""

from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from rich.console import Console
from rich.progress import track

from deltalight.protocol.board import BoardSpec, load_board_yaml
from deltalight.protocol.calibration import Extrinsics, load_extrinsics_yaml, save_extrinsics_yaml
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.source import Source, open_source
from deltalight.services.calibration import result_path, write_result

TransformName = Literal["rgb_from_fisheye", "world_from_fisheye", "depth_from_rgb"]


class ExtrinsicsJob(NamedTuple):
    """The transform to find, and its recording; `board` None = the recording's."""

    source: Path
    what: TransformName
    out: Path
    board: Path | None


def find_transform(job: ExtrinsicsJob, *, force: bool) -> dict[str, Any]:
    """Finds a transform, writes it beside the others, and returns its figures.

    Raises:
        DeltalightError: the recording does not determine it, or it is known already and `force` is not given.
    """
    path = result_path(job.out, "extrinsics.yaml", force=True)
    known = load_extrinsics_yaml(path) if path.exists() else Extrinsics()
    if getattr(known, job.what) is not None and not force:
        raise DeltalightError(f"{path} has {job.what} already; overwrite it with --force.")
    board = None if job.board is None else load_board_yaml(job.board)
    source = open_source(job.source, board)
    transform, figures = _find(job.what, source, board_of(source, job.source))
    others = {field.name: getattr(known, field.name) for field in fields(Extrinsics)}
    result = Extrinsics(**{**others, job.what: transform})
    write_result(path, lambda aside: save_extrinsics_yaml(aside, result))
    return {"transform": job.what, **figures, "matrix": np.round(transform, 6).tolist(), "written": str(path)}


def board_of(source: Source, path: Path) -> BoardSpec:
    """Returns the board of a source.

    Raises:
        DeltalightError: the source describes none.
    """
    if source.board is None:
        raise DeltalightError(f"{path} describes no marker board; name it with --target board.yaml.")
    return source.board


def _find(
    what: TransformName, source: Source, board: BoardSpec
) -> tuple[Float64[np.ndarray, "4 4"], dict[str, Any]]:
    if what == "depth_from_rgb":
        return _depth_from_rgb(source, board)
    from deltalight.sensor_node.calibration.extrinsics import (
        mean_placement,
        rgb_from_fisheye_poses,
        world_from_fisheye_poses,
    )

    poses = rgb_from_fisheye_poses if what == "rgb_from_fisheye" else world_from_fisheye_poses
    placement = mean_placement(list(poses(_with_fisheye(_watched(source)), board)), what)
    figures = {
        "poses": placement.poses,
        "outliers": placement.outliers,
        "spread_mm": round(1e3 * placement.spread_m, 3),
        "spread_deg": round(placement.spread_deg, 4),
    }
    return placement.transform, figures


def _depth_from_rgb(source: Source, board: BoardSpec) -> tuple[Float64[np.ndarray, "4 4"], dict[str, Any]]:
    from deltalight.sensor_node.calibration.depth_extrinsics import depth_views, place_depth_sensor

    start = source.extrinsics.depth_from_rgb
    placement = place_depth_sensor(
        depth_views(_watched(source), board), board, np.eye(4) if start is None else start
    )
    figures = {
        "views": placement.views,
        "rms_mm": round(1e3 * placement.rms_m, 3),
        "uncertainty_mm": round(1e3 * placement.sigma_m, 3),
        "uncertainty_deg": round(placement.sigma_deg, 4),
    }
    return placement.transform, figures


def _watched(source: Source) -> Iterator[SensorFrame]:
    """Yields the frames of a source, with a progress bar on stderr."""
    console = Console(stderr=True)
    hidden = not console.is_terminal  # it would leave an empty line in a file
    yield from track(
        source, "looking for the board", len(source), console=console, transient=True, disable=hidden
    )


def _with_fisheye(frames: Iterable[SensorFrame]) -> Iterator[SensorFrame]:
    """Yields the frames that have a picture of the fish-eye camera.

    Raises:
        DeltalightError: none has one.
    """
    found = False
    for frame in frames:
        if frame.fisheye is not None:
            found = True
            yield frame
    if not found:
        raise DeltalightError(
            "the source holds no pictures of a fish-eye camera; record a node that has one (`--fisheye`)."
        )
