"""How much of the GPU's memory things take."""

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import sizes_bytes


def test_what_several_hold_counts_for_the_one_that_holds_least(gpu: GpuContext) -> None:
    picture = gpu.ctx.texture((4, 3), 4, dtype="f1")
    depth = gpu.ctx.texture((4, 3), 1, dtype="f4")
    table = gpu.ctx.buffer(reserve=100)
    everything = {"picture": picture, "depth": depth, "table": table, "count": 3}
    assert sizes_bytes([everything, (picture, depth), picture, [table, 1.0], None]) == [0, 48, 48, 100, 0]
    assert sizes_bytes([everything, everything]) == [48 + 48 + 100, 0]
    for item in (picture, depth, table):
        item.release()
