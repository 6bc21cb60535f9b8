"""`deltalight calibrate photometric`: the camera's response, or the albedo of the board's paper."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.board import load_board_yaml, save_board_yaml
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.source import open_source
from deltalight.services.calibration import result_path, write_result
from deltalight.services.calibration_extrinsics import board_of


def find_response(source: Path, eye: Literal["rgb", "fisheye"], out: Path, *, force: bool) -> dict[str, Any]:
    """Finds a response; writes `out`/response.txt, or the fish-eye's into its calibration/fisheye.yaml.

    Raises:
        DeltalightError: the bracket does not determine it, or there is one already and `force` is not given.
    """
    from deltalight.sensor_node.calibration.photometric import calibrate_response, read_bracket

    path = out / "calibration" / "fisheye.yaml" if eye == "fisheye" else out / "response.txt"
    _require_free(path, eye, force=force)
    response = calibrate_response(read_bracket(source, eye))
    if eye == "fisheye":
        _write_into_fisheye(path, response.table)
    else:
        write_result(path, lambda aside: np.savetxt(aside, response.table, fmt="%.9g"))
    return {
        "pictures": response.pictures,
        "residual_percent": round(100 * response.residual, 2),
        "light_of_code_128": [round(float(value), 4) for value in response.table[128]],
        "written": str(path),
    }


def _require_free(path: Path, eye: str, *, force: bool) -> None:
    from deltalight.protocol.fisheye_lens import load_fisheye_yaml

    if eye == "fisheye" and not path.exists():
        raise DeltalightError(f"{path} does not exist; run `deltalight calibrate fisheye` first.")
    has_one = path.exists() and (eye == "rgb" or load_fisheye_yaml(path).response is not None)
    if has_one and not force:
        raise DeltalightError(f"{path} holds a response already; overwrite it with --force.")


def _write_into_fisheye(path: Path, table: Float32[np.ndarray, "256 3"]) -> None:
    from deltalight.protocol.fisheye_lens import load_fisheye_yaml, save_fisheye_yaml

    calibration = replace(load_fisheye_yaml(path), response=table)
    write_result(path, lambda aside: save_fisheye_yaml(aside, calibration))


def find_paper_albedo(
    source: Path, card: tuple[str, float], out: Path, board: Path | None, *, force: bool
) -> dict[str, Any]:
    """Finds the paper's albedo by a grey card (position, albedo); writes it into `out`/calibration/board.yaml.

    Raises:
        DeltalightError: the pictures do not show it, or the board has one already and `force` is not given.
    """
    from deltalight.sensor_node.calibration.photometric import paper_albedo, parse_card

    path = result_path(out, "board.yaml", force=True)
    grey = parse_card(*card)
    frames = open_source(source, None if board is None else load_board_yaml(board))
    spec = load_board_yaml(path) if path.exists() and board is None else board_of(frames, source)
    if spec.white_albedo is not None and not force:
        raise DeltalightError(
            f"{path} has white_albedo {spec.white_albedo} already; overwrite it with --force."
        )
    found = paper_albedo(frames, spec, grey)
    result = spec.replaced(white_albedo=round(found.albedo, 4))
    write_result(path, lambda aside: save_board_yaml(aside, result))
    return {
        "white_albedo": round(found.albedo, 4),
        "pictures": found.pictures,
        "spread_percent": round(100 * found.spread, 2),
        "unevenness_percent": round(100 * found.residual, 2),
        "written": str(path),
    }
