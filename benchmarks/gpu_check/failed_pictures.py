"""The protected pictures that failed, in one picture: a row each, with its golden and the difference."""

from pathlib import Path

import cv2
import numpy as np

from deltalight.benchmarks.gpu_check.beside_tests import ComparedPicture, Picture
from deltalight.protocol.files import write_png

NAME = "failed_pictures.png"
LABEL_WIDTH = 240
WHITE = (255, 255, 255)
GAIN = 8  # of the difference, so that a code or two can be seen


class FailedPictures:
    """Writes NAME into a folder anew with every picture that is added."""

    def __init__(self, out: Path) -> None:
        self._path = out / NAME
        self._rows: list[Picture] = []

    def add(self, one: ComparedPicture) -> None:
        """Add a row: label, picture, golden (black where missing), difference eight times as strong."""
        golden = np.zeros_like(one.picture) if one.golden is None else one.golden
        difference = np.abs(one.picture.astype(int) - golden) * GAIN
        clipped = np.minimum(difference, 255).astype(np.uint8)
        self._rows.append(np.hstack([_label(one), one.picture, golden, clipped]))
        write_png(self._path, np.vstack(self._rows))


def _label(one: ComparedPicture) -> Picture:
    label = np.zeros((one.picture.shape[0], LABEL_WIDTH, 3), np.uint8)
    for line, text in enumerate((one.name, one.complaint.split(",")[0])):
        cv2.putText(label, text, (6, 24 + 24 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.4, WHITE, 1, cv2.LINE_AA)
    return label
