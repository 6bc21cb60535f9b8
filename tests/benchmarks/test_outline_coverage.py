"""Coverage by samples and by steps of the outline: what closed forms say, and what the docs conclude."""

import numpy as np
import pytest

from deltalight.benchmarks.outline_coverage import by_steps, errors


def test_a_step_becomes_a_line() -> None:
    """Eight pixels long, with turns up at its left and down at its right: as Reshetov's Z."""
    mask = np.zeros((8, 24), bool)
    mask[4:, :] = True
    mask[3, :8] = True  # the outline is a row higher on the left,
    mask[4, 16:] = False  # and a row lower on the right
    found = by_steps(mask)
    line = 0.5 - (np.arange(8, 16) + 0.5 - 8) / 8  # its height above the step, in the middles of pixels
    assert found[3, 8:12] == pytest.approx(line[:4])
    assert found[4, 12:16] == pytest.approx(1 + line[4:])
    assert (found[3, 12:16] == 0).all()
    assert (found[4, 8:12] == 1).all()


def test_straight_outlines_stay() -> None:
    mask = np.zeros((20, 20), bool)
    mask[:, 10:] = True
    assert np.array_equal(by_steps(mask), mask)


def test_eight_samples_are_better_than_lines_on_curves_and_thin_things() -> None:
    found = errors(12)
    rms = {name: {kind: np.sqrt(np.mean(e**2)) for kind, e in of.items()} for name, of in found.items()}
    eight, lines = rms["8 samples"], rms["MLAA"]
    assert np.abs(found["8 samples"]["half planes"]).max() < 0.19
    assert eight["half planes"] == pytest.approx(0.06, abs=0.01)
    for kind in ("discs", "bars 1 px", "bars 0.5 px"):
        assert eight[kind] < 0.6 * lines[kind] < 0.6 * rms["one sample"][kind]
    assert lines["near an axis"] < 0.3 * rms["one sample"]["near an axis"]
