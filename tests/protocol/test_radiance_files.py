import importlib
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.radiance_files import read_linear, write_exr


def write_channels(path: Path, **channels: np.ndarray) -> None:
    exr = importlib.import_module("OpenEXR")
    with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels) as file:
        file.write(str(path))


def test_half_floats_and_an_alpha_channel_are_read_as_rgb(tmp_path: Path) -> None:
    pixels = np.arange(4 * 8 * 4, dtype=np.float16).reshape(4, 8, 4) - 8
    write_channels(tmp_path / "half.exr", RGBA=pixels)
    picture = read_linear(tmp_path / "half.exr")
    assert picture.dtype == np.float32
    assert np.array_equal(picture, np.maximum(pixels[..., :3], 0))


def test_a_picture_without_colours_is_refused(tmp_path: Path) -> None:
    write_channels(tmp_path / "grey.exr", Y=np.ones((4, 8), np.float32))
    with pytest.raises(DeltalightError, match="picture of R, G and B"):
        read_linear(tmp_path / "grey.exr")


def test_a_file_that_cannot_be_written_is_a_fault_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="absent"):
        write_exr(tmp_path / "absent" / "a.exr", np.ones((4, 8, 3), np.float32))
