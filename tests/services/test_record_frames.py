"""Raw frames put together again from their messages, and the queue that brings the messages."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, SensorFrame
from deltalight.protocol.messages import ColorMessage
from deltalight.protocol.publisher import Publisher
from deltalight.services.raw_frames import RawFrameAssembler
from deltalight.services.stream_queue import QUEUED_MESSAGES, StreamQueue
from tests.protocol.fisheye_samples import assert_same_frames, assert_same_pictures, linear
from tests.services.record_samples import BOARD, PERIOD_NS, frames, messages


def assembled(
    sent: Iterable[SensorFrame | Sequence[list[bytes]]], assembler: RawFrameAssembler
) -> list[SensorFrame]:
    """What comes out while frames (or chosen messages of them) go in."""
    found = []
    for item in sent:
        for multipart in messages(item).values() if isinstance(item, SensorFrame) else item:
            assembler.add(*decode(multipart))
            while (frame := assembler.take()) is not None:
                found.append(frame)
    return found


def raw_frames(count: int, **options: bool) -> list[SensorFrame]:
    """Frames as a node sends them: no renderer has seen them."""
    return [replace(frame, composite=None) for frame in frames(count, **options)]


def only(frame: SensorFrame, *streams: str) -> list[list[bytes]]:
    sent = messages(frame)
    return [sent[stream] for stream in streams]


@pytest.mark.parametrize("as_jpeg", [True, False])
def test_frames_come_back_bit_for_bit_without_the_first(as_jpeg: bool) -> None:
    sent = raw_frames(6, as_jpeg=as_jpeg, with_fisheye=True)
    assembler = RawFrameAssembler()
    found = assembled(sent, assembler)
    for ours, theirs in zip(found, sent[1:], strict=True):
        assert_same_frames(ours, theirs)
    assert found[0].fisheye is not found[-1].fisheye
    assert found[0].fisheye is found[1].fisheye, "the same pictures are one object"
    assert found[0].camera is found[1].camera
    assert (assembler.node, assembler.board) == ("cam", BOARD)
    assert not any(assembler.missing.values())


def test_linear_fisheye_pictures_come_back_bit_for_bit() -> None:
    sent = [replace(frame, fisheye=linear(frame.timestamp_ns)) for frame in raw_frames(3)]
    for ours, theirs in zip(assembled(sent, RawFrameAssembler()), sent[1:], strict=True):
        assert_same_pictures(ours.fisheye, theirs.fisheye)


def test_before_the_first_fisheye_picture_the_first_holds() -> None:
    early, *sent = raw_frames(3)
    later = [replace(frame, fisheye=linear(sent[1].timestamp_ns)) for frame in sent]
    found = assembled([early, *later], RawFrameAssembler())
    assert_same_pictures(found[0].fisheye, later[0].fisheye)


def test_fisheye_pictures_of_a_replay_that_began_again_stay_in_order() -> None:
    sent = raw_frames(6)
    shown = [linear(frame.timestamp_ns) for frame in sent[:2]]
    again = [replace(frame, fisheye=shown[index % 2]) for index, frame in enumerate(sent)]
    found = assembled(again, RawFrameAssembler())
    times = [frame.fisheye.timestamp_ns for frame in found if frame.fisheye is not None]
    assert times == sorted(set(times))
    for ours, theirs in zip(found, again[1:], strict=True):
        assert ours.fisheye is not None
        assert theirs.fisheye is not None
        assert np.array_equal(ours.fisheye.pictures[0], theirs.fisheye.pictures[0])


def test_a_pose_that_the_board_showed_is_left_to_the_replay() -> None:
    first, second = raw_frames(2)
    detected = messages(second, detected=BoardPose(np.eye(4), reprojection_error_px=0.2))
    found = assembled([first, list(detected.values())], RawFrameAssembler())
    assert [frame.world_from_camera for frame in found] == [None]


def test_partners_may_come_after_their_colour_picture() -> None:
    first, second, third = raw_frames(3)
    late = [only(second, "color"), only(third, "depth", "pose", "color"), only(second, "pose", "depth")]
    found = assembled([first, *late], RawFrameAssembler())
    for ours, theirs in zip(found, (second, third), strict=True):
        assert_same_frames(ours, theirs)


def test_a_lost_partner_is_waited_for_two_pictures_long_and_counted() -> None:
    sent = raw_frames(6)
    assembler = RawFrameAssembler()
    assert not assembled([sent[0], only(sent[1], "pose", "color"), sent[2]], assembler)
    found = assembled([sent[3], only(sent[4], "depth", "color"), sent[5]], assembler)
    assert [frame.frame_id for frame in found] == [1, 2, 3]
    assert found[0].depth is None
    assert assembler.missing == {"color": 0, "depth": 1, "pose": 0}
    last = assembler.take(is_idle=True)
    assert last is not None
    assert (last.frame_id, last.world_from_camera) == (4, None)
    assert assembler.missing["pose"] == 1


def test_numbers_that_are_skipped_are_counted_and_a_new_start_is_not() -> None:
    sent = raw_frames(5)
    numbers = (40, 41, 45, 46, 0)
    renumbered = [replace(frame, frame_id=number) for frame, number in zip(sent, numbers, strict=True)]
    assembler = RawFrameAssembler()
    assert len(assembled(renumbered, assembler)) == 4
    assert assembler.missing["color"] == 3


def test_other_nodes_are_told_and_not_mixed_in() -> None:
    sent = raw_frames(3)
    assembler = RawFrameAssembler()
    others = [list(messages(frame, node="desk").values()) for frame in sent]
    mixed = [item for pair in zip(sent, others, strict=True) for item in pair]
    assert len(assembled(mixed, assembler)) == 2
    assert assembler.foreign == {"desk": 9}
    chosen = RawFrameAssembler("desk")
    assert len(assembled(mixed, chosen)) == 2
    assert chosen.foreign == {"cam": 9}


def test_a_broken_picture_costs_its_own_frame_only() -> None:
    first, second, third = raw_frames(3)
    broken = messages(second)
    broken["color"][2] = broken["color"][2][:200]
    assembler = RawFrameAssembler()
    with pytest.raises(DeltalightError, match="jpeg"):
        assembled([first, list(broken.values())], assembler)
    assert_same_frames(assembled([third], assembler)[0], third)


def test_the_queue_keeps_order_and_counts_what_finds_no_room() -> None:
    frame = raw_frames(1)[0]
    publisher = Publisher("tcp://127.0.0.1:*", streams=100)
    queue = StreamQueue([publisher.endpoint], ["depth", "color"])
    try:
        waited_until_s = time.monotonic() + 20
        while queue.take(0.05) is None:  # until the subscription has arrived
            assert time.monotonic() < waited_until_s
            publisher.send(messages(replace(frame, frame_id=0))["color"])
        while queue.take(0.2) is not None:
            pass
        for number in range(1, QUEUED_MESSAGES + 21):
            sent = messages(replace(frame, frame_id=number, timestamp_ns=number * PERIOD_NS))
            publisher.send(sent["pose"])
            publisher.send(sent["color"])
            if number == QUEUED_MESSAGES:
                publisher.send(sent["depth"])
        while sum(queue.drops.values()) < 20:
            assert time.monotonic() < waited_until_s
            time.sleep(0.01)
        queue.close()
        taken = []
        while (multipart := queue.take(0)) is not None:
            taken.append(decode(multipart)[0])
    finally:
        queue.close()
        publisher.close()
    numbers = [message.frame_id for message in taken if isinstance(message, ColorMessage)]
    assert numbers == list(range(1, QUEUED_MESSAGES + 1))
    assert [message.stream for message in taken if message.stream != "color"] == ["depth"]
    assert queue.drops == {"color": 20}
