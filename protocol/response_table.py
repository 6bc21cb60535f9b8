"""A camera's response: 256 rows of linear R G B, one for each code."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.errors import DeltalightError


def load_response_table(path: Path) -> Float32[np.ndarray, "256 3"]:
    """Reads a response from a text file; `#` begins a comment.

    Raises:
        DeltalightError: the file is missing or does not hold such a table.
    """
    try:
        table = np.loadtxt(path, dtype=np.float32, comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise DeltalightError(f"{path} is not a table of numbers; write 256 rows of linear R G B.") from error
    return require_response(table, str(path))


def require_response(values: object, name: str) -> Float32[np.ndarray, "256 3"]:
    """Returns a validated response table, read-only; `name` names it in errors.

    Raises:
        DeltalightError: it is not 256 rows of three finite numbers, zero or more.
    """
    try:
        table = np.array(values, np.float32)
    except (TypeError, ValueError):
        table = np.zeros(0, np.float32)
    if table.shape != (256, 3) or not np.isfinite(table).all() or (table < 0).any():
        raise DeltalightError(f"{name} does not hold 256 rows of linear R G B, zero or more; correct it.")
    table.flags.writeable = False
    return table
