"""Records in rows of texels: the texture holds what was written, and only rows that changed are uploaded."""

import numpy as np
import pytest

from deltalight.benchmarks.speed.instruments import counted
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.texel_rows import TexelRows

pytestmark = pytest.mark.usefixtures("clean_gl")
WIDTH = 16
ROW_BYTES = 16 * WIDTH


def held(rows: TexelRows) -> np.ndarray:
    return np.frombuffer(rows.texture.read(), np.float32).reshape(-1, 4)


def test_only_rows_that_changed_are_uploaded(gpu: GpuContext) -> None:
    rows = TexelRows(gpu, WIDTH, "f4")
    rows.reserve(6 * WIDTH)
    expected = np.zeros((6 * WIDTH, 4), np.float32)
    np.testing.assert_array_equal(held(rows), expected)
    with counted() as counts:
        for first, count in ((WIDTH + 3, 2 * WIDTH), (5 * WIDTH, 1)):
            rows.renewed(first, count)[:] = expected[first : first + count] = first
        assert rows.texture is rows.texture
    np.testing.assert_array_equal(held(rows), expected)
    assert (counts.uploads, counts.uploaded_bytes) == (2, 4 * ROW_BYTES)
    rows.release()


def test_what_finds_room_stays(gpu: GpuContext) -> None:
    rows = TexelRows(gpu, WIDTH, "f4")
    rows.reserve(2 * WIDTH)
    rows.renewed(0, 2 * WIDTH)[:] = 7
    for count in (9 * WIDTH, WIDTH):
        rows.reserve(count)
        found = held(rows)
        assert (found[: min(2 * WIDTH, count)] == 7).all()
    rows.release()


@pytest.mark.parametrize("count", [0, 1, WIDTH, WIDTH + 1, 4 * WIDTH, 8 * WIDTH])
def test_textures_are_never_a_power_of_two_high(gpu: GpuContext, count: int) -> None:
    """Else llvmpipe would compile all kernels that trace rays anew with an object more."""
    rows = TexelRows(gpu, WIDTH, "f4")
    rows.reserve(count)
    height = rows.texture.size[1]
    assert height & (height - 1)
    assert height * WIDTH >= count
    rows.release()
