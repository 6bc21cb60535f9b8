"""The moving picture to share: what is left of the line, what is right, and how large it is."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deltalight.services.before_after import (
    PERIOD_MS,
    PICTURES,
    ROUNDS,
    WIDTH,
    before_after_gif,
    write_before_after_video,
)

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


def test_the_same_as_a_video(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    before, after = (np.full((120, 160, 3), color, np.uint8) for color in (RED, BLUE))
    write_before_after_video(tmp_path / "a.mp4", before, after)
    with av.open(str(tmp_path / "a.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(pictures) == ROUNDS * PICTURES
    assert pictures[0].shape == (120, 160, 3)
    red_shares = [(picture[..., 0] > picture[..., 2] + 60).mean() for picture in pictures]
    assert max(red_shares) > 0.9
    assert min(red_shares) < 0.1
    np.testing.assert_allclose(red_shares[:PICTURES], red_shares[PICTURES : 2 * PICTURES], atol=0.02)
