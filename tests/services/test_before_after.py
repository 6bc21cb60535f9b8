"""The moving picture to share: what is left of the line, what is right, and how large it is."""

from io import BytesIO

import numpy as np
from PIL import Image

from deltalight.services.before_after import PERIOD_MS, PICTURES, WIDTH, before_after_gif

RED, BLUE = (200, 30, 30), (30, 30, 200)


def test_a_line_divides_before_from_after_and_goes_across() -> None:
    before, after = (np.full((600, 800, 3), color, np.uint8) for color in (RED, BLUE))
    before[::7, ::11] = (10, 200, 10)  # something to keep
    coded = before_after_gif(before, after)
    picture = Image.open(BytesIO(coded))
    assert (picture.size, picture.n_frames) == ((WIDTH, 360), PICTURES)  # type: ignore[attr-defined]
    assert (picture.info["loop"], picture.info["duration"]) == (0, PERIOD_MS)
    columns = []
    for number in range(PICTURES):
        picture.seek(number)
        shown = np.asarray(picture.convert("RGB")).astype(int)
        white = (shown.min(axis=2) > 240).all(axis=0)
        (line,) = np.flatnonzero(white[:-1] & white[1:])
        columns.append(line)
        assert np.abs(shown[:, line + 2 :] - BLUE).max() < 12
        assert np.abs(np.median(shown[:, :line], axis=(0, 1)) - RED).max() < 30
    assert max(columns) - min(columns) > 0.85 * WIDTH
    assert len(coded) < 1_000_000
