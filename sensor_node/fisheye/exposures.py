"""Exposure bracket -> one linear picture in camera units."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import FisheyePictures, decode_lut

CLIPPED_CODE = 250
"""Codes from here are white: the last 2 % hold the shoulder of a response and the ringing of JPEG."""
FULL_WELL = 1e4
"""Electrons at white, for Poisson noise: 5,000 to 50,000 for sensors from webcams to reflex cameras.

Beside the steps of an 8-bit code it matters little, so an approximate number is enough.
"""
READ_NOISE = 1e-3
"""Of white: some 10 electrons; linear pictures have no steps that would bound their weight in the dark."""

Picture = UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w 3"]


class LinearPicture(NamedTuple):
    """The sensor's light, 1.0 = white at the reference exposure; `clipped` where it is a lower bound."""

    linear: Float32[np.ndarray, "h w 3"]
    clipped: Bool[np.ndarray, "h w"]


def reference_exposure(exposures_s: Iterable[float | None]) -> float | None:
    """Returns the exposure in which 1.0 is white: the longest of a bracket, None if none is reported."""
    return max((each for each in exposures_s if each is not None), default=None)


def merge_bracket(bracket: FisheyePictures, reference_s: float | None) -> LinearPicture:
    """Merges exposures, each weighted by the inverse variance of the light that it indicates.

    An exposure of t (in reference exposures) that shows the linear value c indicates c/t with a variance of v(c)/t^2,
    v being Poisson noise, read noise and the rounding of the code. Clipped values have no weight, nor do values
    beside clipped ones in the same exposure (demosaicing, JPEG and resizing mix them), except in the shortest
    exposure: where that clips, the value is a lower bound. Linear (float32) pictures clip at 1.0 in a bracket; a
    single one counts as a finished picture that clips nowhere.

    Args:
        bracket: pictures of one moment.
        reference_s: exposure in which white is 1.0; an exposure of None is this one.

    Raises:
        DeltalightError: the pictures do not fit each other or the calibration, or values are not finite.
    """
    _check(bracket)
    scales = [_scale(exposure, reference_s) for exposure in bracket.exposures_s]
    if len(scales) == 1:
        return _single(bracket, scales[0])
    lut = decode_lut(bracket.calibration.response)
    order = np.argsort(scales)
    height, width, _ = bracket.pictures[0].shape
    total, weights = np.zeros((2, height, 3 * width), np.float32)
    for which in order:
        scale, picture = scales[which], bracket.pictures[which]
        reading = _read(picture, scale, lut)
        clipped = (
            reading.clipped if which == order[0] else cv2.dilate(reading.clipped, np.ones((3, 3), np.uint8))
        )
        # As one channel, so that OpenCV takes a mask for each value.
        trusted = (1 - clipped).reshape(height, -1)
        cv2.accumulate(reading.weight.reshape(height, -1), weights, trusted)
        cv2.accumulate(reading.weighted_light.reshape(height, -1), total, trusted)
    unknown = (weights == 0).reshape(height, width, 3)
    linear = (total / np.maximum(weights, np.finfo(np.float32).tiny)).reshape(height, width, 3)
    if unknown.any():
        shortest = _linear(bracket.pictures[order[0]], lut) / np.float32(scales[order[0]])
        linear[unknown] = shortest[unknown]
    return LinearPicture(linear, np.asarray(unknown.any(axis=-1)))


class _Reading(NamedTuple):
    """For every value of one exposure: inverse variance of the indicated light, that times the light, and white."""

    weight: Float32[np.ndarray, "h w 3"]
    weighted_light: Float32[np.ndarray, "h w 3"]
    clipped: UInt8[np.ndarray, "h w 3"]


def _read(picture: Picture, scale: float, lut: Float32[np.ndarray, "256 3"]) -> _Reading:
    if picture.dtype != np.uint8:
        weight = scale**2 / (np.maximum(picture, 0) / FULL_WELL + READ_NOISE**2)
        light = weight * picture / scale
        return _Reading(weight.astype(np.float32), light.astype(np.float32), (picture >= 1).astype(np.uint8))
    step = np.gradient(lut, axis=0)
    weight = scale**2 / (lut / FULL_WELL + READ_NOISE**2 + step**2 / 12)
    weight_of, light_of = (table[None].astype(np.float32) for table in (weight, weight * lut / scale))
    clipped = (picture >= CLIPPED_CODE).astype(np.uint8)
    return _Reading(cv2.LUT(picture, weight_of), cv2.LUT(picture, light_of), clipped)


def _linear(picture: Picture, lut: Float32[np.ndarray, "256 3"]) -> Float32[np.ndarray, "h w 3"]:
    return picture if picture.dtype != np.uint8 else cv2.LUT(picture, lut[None])


def _single(bracket: FisheyePictures, scale: float) -> LinearPicture:
    picture = bracket.pictures[0]
    light = _linear(picture, decode_lut(bracket.calibration.response)) / np.float32(scale)
    if picture.dtype != np.uint8:
        return LinearPicture(light, np.zeros(picture.shape[:2], bool))
    return LinearPicture(light, np.asarray((picture >= CLIPPED_CODE).any(axis=-1)))


def _scale(exposure_s: float | None, reference_s: float | None) -> float:
    """Returns the exposure in units of the reference."""
    return 1.0 if exposure_s is None or reference_s is None else exposure_s / reference_s


def _check(bracket: FisheyePictures) -> None:
    lens, pictures = bracket.calibration.lens, bracket.pictures
    if not pictures or len(pictures) != len(bracket.exposures_s):
        raise DeltalightError(
            f"a fish-eye bracket of {len(pictures)} pictures has {len(bracket.exposures_s)} exposures; "
            "give one for each picture."
        )
    for picture, exposure in zip(pictures, bracket.exposures_s, strict=True):
        _check_picture(picture, lens.width, lens.height)
        if exposure is not None and not 0 < exposure < np.inf:
            raise DeltalightError(f"a fish-eye exposure of {exposure} s is impossible; give it in seconds.")


def _check_picture(picture: Picture, width: int, height: int) -> None:
    if picture.shape != (height, width, 3):
        raise DeltalightError(
            f"a fish-eye picture has the shape {picture.shape} but its calibration is for {width}x{height} pixels; "
            "calibrate at the size that is recorded."
        )
    if picture.dtype not in (np.uint8, np.float32):
        raise DeltalightError(f"a fish-eye picture holds {picture.dtype}; give uint8 or linear float32.")
    if picture.dtype == np.float32 and not np.isfinite(picture).all():
        raise DeltalightError("a linear fish-eye picture holds values that are not finite; export it again.")


def display_picture(
    pictures: Sequence[Picture], merged: LinearPicture, inside: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a coded picture for display: the exposure nearest to middle grey, or linear pictures coded.

    `inside` is where the lens sees; pixels outside say nothing about the exposure.
    """
    some = inside[::4, ::4]
    coded = [picture for picture in pictures if picture.dtype == np.uint8]
    if coded:
        # sRGB codes 18 % grey as 118.
        return min(coded, key=lambda picture: abs(float(picture[::4, ::4][some].mean()) - 118))
    middle = float(np.median(merged.linear[::4, ::4][some]))
    light = merged.linear * np.float32(0.18 / middle if middle > 0 else 1.0)
    return np.searchsorted(decode_lut(None)[:, 0], np.clip(light, 0, 1)).astype(np.uint8)
