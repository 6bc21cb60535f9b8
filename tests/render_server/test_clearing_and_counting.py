"""Buffers are cleared on the GPU, and lists are walked by as many workgroups as the GPU counted."""

from collections.abc import Iterator
from dataclasses import replace

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu.clearing import (
    CLEARING_GROUPS,
    clear_ahead,
    clear_buffer,
    clear_buffers,
    clear_for_later,
)
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import BindingError, Dispatch, watched
from deltalight.render_server.gpu.list_groups import ListGroups
from deltalight.render_server.passes.camera_image import CameraImage
from tests.render_server.tiny_kernel import MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")
FULL = 0xFFFFFFFF
WORDS = 256 * CLEARING_GROUPS + 77  # more than the workgroups clear in one stride, and no multiple of four
WALK = """
#include "common/work_list.glsl"
"""


@pytest.fixture(params=["software", "hardware"])
def either(gpu: GpuContext, request: pytest.FixtureRequest) -> GpuContext:
    """The context as it is, and as that of a GPU."""
    return replace(gpu, is_software=request.param == "software")


@pytest.fixture
def full(gpu: GpuContext) -> Iterator[moderngl.Buffer]:
    buffer = gpu.ctx.buffer(np.full(WORDS, FULL, np.uint32).tobytes())
    yield buffer
    buffer.release()


@pytest.fixture
def groups(gpu: GpuContext) -> Iterator[ListGroups]:
    counted = ListGroups(gpu, 4)
    yield counted
    counted.release()


def words(buffer: moderngl.Buffer) -> np.ndarray:
    return np.frombuffer(buffer.read(), np.uint32)


def test_a_buffer_is_cleared_whole(either: GpuContext, full: moderngl.Buffer) -> None:
    clear_buffer(either, full)
    assert not words(full).any()


@pytest.mark.parametrize("count", [1, 300])
def test_the_first_bytes_of_a_buffer_are_cleared(
    either: GpuContext, full: moderngl.Buffer, count: int
) -> None:
    clear_buffer(either, full, 4 * count)
    assert not words(full)[:count].any()
    assert (words(full)[count:] == FULL).all()


def test_on_a_gpu_no_buffer_is_mapped_to_be_cleared(
    gpu: GpuContext, full: moderngl.Buffer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def clear(*_args: object, **_more: object) -> None:
        raise AssertionError("it is mapped")

    monkeypatch.setattr(moderngl.Buffer, "clear", clear)
    seen: list[Dispatch] = []
    hardware = replace(gpu, is_software=False)
    with watched(hardware, seen.append):
        clear_buffer(hardware, full)
        clear_buffer(hardware, full, 400)
    assert [(one.kernel, one.size) for one in seen] == [
        ("clear_buffer", (CLEARING_GROUPS, 1, 1)),
        ("clear_buffer", (1, 1, 1)),
    ]
    assert seen[0].written == {"Cleared": full}


def test_what_was_used_up_is_cleared_once_when_the_next_frame_begins(gpu: GpuContext) -> None:
    """By the kernel that makes its picture linear."""
    hardware = replace(gpu, is_software=False)
    image = CameraImage(hardware, (8, 8))

    def begin_frame() -> None:
        image.is_linear = False
        image.linearize(begins_frame=True)

    buffers = [gpu.ctx.buffer(np.full(8, FULL, np.uint32).tobytes()) for _ in range(10)]
    short, released, again = buffers[0], buffers[1], buffers[2]
    seen: list[Dispatch] = []
    with watched(hardware, seen.append):
        clear_ahead(hardware, (short, 4), *((each, 32) for each in buffers[1:]))
        assert not seen
        released.release()
        clear_buffer(hardware, again)  # used in this frame already, and not used up since
        again.write(b"\xff" * 32)
        begin_frame()
        assert len(seen) == 2
        assert [words(each)[0] for each in buffers if each is not released] == [0, FULL, *[0] * 7]
        clear_buffers(hardware, *((each, 32) for each in buffers[3:]))
        begin_frame()
        assert [one.kernel.split()[0] for one in seen] == ["clear_buffer", "linearize", "linearize"]
        clear_buffers(hardware, (short, 32))  # more than was cleared
        buffers[3].write(b"\xff" * 32)
        clear_buffer(hardware, buffers[3])
        assert len(seen) == 5
    assert not words(short).any()
    assert not words(buffers[3]).any()
    image.release()
    for each in buffers:
        each.release()


def test_what_was_cleared_for_later_is_not_cleared_again_until_it_is_filled(gpu: GpuContext) -> None:
    hardware = replace(gpu, is_software=False)
    one, other = buffers = [gpu.ctx.buffer(np.full(8, FULL, np.uint32).tobytes()) for _ in range(2)]
    seen: list[Dispatch] = []
    with watched(hardware, seen.append):
        clear_for_later(hardware, (one, 32), (other, 32))
        clear_for_later(hardware, (other, 32))
        clear_buffer(hardware, one)
        clear_buffer(hardware, other)
        assert len(seen) == 1
        assert not any(words(each).any() for each in buffers)
        other.write(b"\xff" * 32)  # by whoever had it cleared
        clear_buffer(hardware, other)
        assert len(seen) == 2
    assert not words(other).any()
    for each in buffers:
        each.release()


def test_the_start_of_a_buffer_is_cleared_between_kernels_and_untouched_by_the_cpu(
    gpu: GpuContext, full: moderngl.Buffer, make: MakeKernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def touch(*_args: object, **_more: object) -> None:
        raise AssertionError("the CPU touches it")

    monkeypatch.setattr(moderngl.Buffer, "clear", touch)
    monkeypatch.setattr(moderngl.Buffer, "write", touch)
    kernel = make("", "values[gl_GlobalInvocationID.x] += 7.0;", "local_size_x = 4")
    for _ in range(2):
        gpu.clear_start(full, 32)
        kernel.run((8,), Out=full)
    assert floats(full, 8) == [7.0] * 8
    assert (words(full)[8:] == FULL).all()


@pytest.mark.parametrize("length", [0, 1, 4, 5, 1023, 1024, 1025, 5000])
def test_every_item_of_a_list_is_met_once(
    gpu: GpuContext, groups: ListGroups, make: MakeKernel, length: int
) -> None:
    """In one row of workgroups or several, the last of them not full."""
    listed = gpu.ctx.buffer(np.array([length, *range(length)], np.uint32).tobytes())
    met = gpu.ctx.buffer(np.zeros(6000, np.uint32).tobytes())
    kernel = make(
        WALK + "layout(std430) buffer Met { uint met[]; };",
        "uint i = counted_group() * 4u + gl_LocalInvocationIndex;\n"
        "if (i < listed_count()) atomicAdd(met[texels[i]], 1u);",
        "local_size_x = 4",
    )
    seen: list[Dispatch] = []
    with watched(gpu, seen.append):
        kernel.run_counted(groups.count(listed), Texels=listed, Met=met, Out=None)
    assert words(met).tolist() == [1] * length + [0] * (6000 - length)
    assert [(one.kernel, one.size) for one in seen] == [("count_groups", (1, 1, 1)), ("tiny", ())]
    assert seen[1].written == {"Met": met}
    for item in (listed, met):
        item.release()


def test_a_counted_run_checks_its_names_too(gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer) -> None:
    kernel = make("uniform float a;", "values[0] = a;")
    groups = gpu.ctx.buffer(np.array([1, 1, 1], np.uint32).tobytes())
    kernel.run_counted(groups, Out=out, a=3.0)
    assert floats(out, 1) == [3.0]
    with pytest.raises(BindingError, match="declares no `b`"):
        kernel.run_counted(groups, Out=out, b=1.0)
    groups.release()
