"""Exposure and white balance of a V4L2 camera through OpenCV's properties."""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import cv2

from deltalight.protocol.errors import DeltalightError

# V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us; V4L2_CID_EXPOSURE_AUTO: 1 = manual, 3 = automatic at a fixed aperture
# (the only two that USB cameras without an iris have). Source: Linux media documentation, camera controls.
EXPOSURE_STEP_S = 1e-4
MANUAL, AUTOMATIC = 1.0, 3.0


class Properties(Protocol):
    """The part of `cv2.VideoCapture` used here."""

    def get(self, prop: int, /) -> float:
        """Returns the value of a property; -1 or 0 if unknown."""

    def set(self, prop: int, value: float, /) -> bool:
        """Sets a property; returns False if that fails."""


class UvcControls:
    """The controls of an open camera; if `known` is False (not V4L2) their units are unknown, and none is used."""

    def __init__(self, source: str, capture: Properties, *, known: bool) -> None:
        self._source, self._capture, self._known = source, capture, known
        self._locked_s: float | None = None

    @property
    def exposure_s(self) -> float | None:
        """Exposure of the current frames, in seconds, as locked or read back; None if not reported."""
        return self._locked_s if self._locked_s is not None else self._read_exposure()

    def set_exposure(self, seconds: float) -> None:
        """Locks the exposure to the nearest of the camera's steps.

        Raises:
            DeltalightError: the camera has no such control, or refuses this value.
        """
        steps = max(round(seconds / EXPOSURE_STEP_S), 1)
        self._choose(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL)
        if not (self._known and self._capture.set(cv2.CAP_PROP_EXPOSURE, float(steps))):
            raise DeltalightError(
                f"{self._source} does not let its exposure be set to {seconds:g} s; leave exposure_s out and set "
                "lock = false."
            )
        self._locked_s = self._read_exposure()

    def set_white_balance(self, kelvin: int) -> None:
        """Locks the colour temperature.

        Raises:
            DeltalightError: the camera has no such control.
        """
        self._choose(cv2.CAP_PROP_AUTO_WB, 0.0)
        if not (self._known and self._capture.set(cv2.CAP_PROP_WB_TEMPERATURE, float(kelvin))):
            raise DeltalightError(
                f"{self._source} does not let its white balance be set; leave white_balance_k out."
            )

    def release(self) -> None:
        """Lets the camera choose both, so that it can settle; controls persist from earlier programs."""
        self._locked_s = None
        self._choose(cv2.CAP_PROP_AUTO_EXPOSURE, AUTOMATIC)
        self._choose(cv2.CAP_PROP_AUTO_WB, 1.0)

    def keep(self, *, exposure: bool, white_balance: bool) -> str:
        """Locks what the camera has chosen; returns what could not be locked, for the user."""
        seconds, kelvin = self._read_exposure(), self._capture.get(cv2.CAP_PROP_WB_TEMPERATURE)
        refused = []
        # A value that the camera does not report must not be guessed: the picture could become black.
        if exposure and (seconds is None or not _taken(partial(self.set_exposure, seconds))):
            refused.append("exposure")
        if white_balance and (kelvin <= 0 or not _taken(partial(self.set_white_balance, int(kelvin)))):
            refused.append("white balance")
        return f"{' and '.join(refused)} cannot be locked" if refused else ""

    def _read_exposure(self) -> float | None:
        steps = self._capture.get(cv2.CAP_PROP_EXPOSURE) if self._known else 0.0
        return steps * EXPOSURE_STEP_S if steps > 0 else None

    def _choose(self, prop: int, value: float) -> None:
        if self._known:
            self._capture.set(prop, value)


def _taken(change: Callable[[], None]) -> bool:
    try:
        change()
    except DeltalightError:
        return False
    return True
