"""The calibration of a fish-eye camera as plain data and a table of bytes, because headers of messages are small."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import msgpack
import numpy as np

from protocol.errors import DeltalightError
from protocol.fisheye_lens import FisheyeCalibration
from protocol.response_table import require_response


def describe_calibration(calibration: FisheyeCalibration) -> tuple[dict[str, object], bytes | None]:
    """Return the calibration without its response as plain data, and the response (None = sRGB).

    The response is 256 x 3 little-endian 32-bit floats.
    """
    response = calibration.response
    table = None if response is None else response.astype("<f4").tobytes()
    return {**calibration.to_dict(), "response": None}, table


def calibration_of(description: Mapping[str, object], response: bytes | None) -> FisheyeCalibration:
    """Create the calibration from the data of `describe_calibration`; equal data give the same object.

    Raises:
        DeltalightError: a value is impossible.
    """
    return _calibration(msgpack.packb(description), response)


# A lens caches costly results, and cameras do not change from picture to picture; few are in use at once.
@lru_cache(maxsize=8)
def _calibration(description: bytes, response: bytes | None) -> FisheyeCalibration:
    try:
        calibration = FisheyeCalibration.from_dict(msgpack.unpackb(description))
    except (ArithmeticError, ValueError) as error:  # numbers that overflow in the lens's polynomial
        raise DeltalightError(
            f"the fish-eye calibration holds numbers that no lens has ({error}); calibrate again."
        ) from error
    if response is None:
        return calibration
    table = np.frombuffer(response, "<f4").reshape(-1, 3)
    return replace(calibration, response=require_response(table, "the fish-eye's response"))
