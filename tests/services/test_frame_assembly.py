"""Pairing of streams: own pose, nearest depth within the tolerance, and what is counted."""

import numpy as np
import pytest

from deltalight.protocol.envelope import EnvelopeError, decode
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.render_server.server.frames import FrameAssembler, PairingSettings
from tests.services.conftest import color, depth, pose

MS = 1_000_000
START = 1_000_000 * MS


def add(assembler: FrameAssembler, *messages: ReceivedMultipart) -> None:
    for multipart in messages:
        message, parts = decode(multipart)
        assembler.add(message, parts, multipart.received_ns)


def test_frame_waits_for_its_own_pose_and_depth() -> None:
    assembler = FrameAssembler()
    add(assembler, pose(6, START - 33 * MS), color(7, START, received_ns=START), depth(7, START, 1.5))
    assert assembler.take(START + MS) is None
    add(assembler, pose(7, START))
    frame = assembler.take(START + MS)
    assert frame is not None
    assert frame.view.frame_id == 7
    assert frame.view.pose is not None
    assert frame.view.depth is not None
    assert frame.view.depth.depth_m[0, 0] == pytest.approx(1.5)
    assert np.all(frame.view.color == 7)
    assert assembler.take(START + MS) is None


def test_newest_complete_frame_wins_and_older_ones_are_counted() -> None:
    assembler = FrameAssembler(needs_depth=False)
    for number in (1, 2, 3):
        add(assembler, color(number, START + number, START), pose(number, START + number))
    frame = assembler.take(START + MS)
    assert frame is not None
    assert frame.view.frame_id == 3
    assert assembler.counts["superseded"] == 2


def test_newer_frame_without_pose_does_not_hold_up_a_complete_one() -> None:
    assembler = FrameAssembler(needs_depth=False)
    add(assembler, color(1, START, START), pose(1, START), color(2, START + 33 * MS, START + 33 * MS))
    frame = assembler.take(START + 34 * MS)
    assert frame is not None
    assert frame.view.frame_id == 1
    assert frame.view.pose is not None
    add(assembler, pose(2, START + 33 * MS))
    following = assembler.take(START + 35 * MS)
    assert following is not None
    assert following.view.frame_id == 2
    assert assembler.counts["superseded"] == 0


def test_pose_of_an_earlier_turn_of_a_loop_is_not_taken() -> None:
    assembler = FrameAssembler(needs_depth=False)
    add(assembler, pose(0, START), color(0, START + 5000 * MS, START + 5000 * MS))
    assert assembler.take(START + 5001 * MS) is None


def test_depth_beyond_the_tolerance_is_unpaired_and_counted_after_the_patience() -> None:
    assembler = FrameAssembler(PairingSettings(depth_tolerance_ms=20, patience_ms=100))
    add(assembler, color(1, START, START), pose(1, START), depth(1, START + 21 * MS))
    assert assembler.take(START + 99 * MS) is None
    assert assembler.counts["unpaired_depth"] == 0
    assert assembler.take(START + 100 * MS) is None
    assert assembler.counts["unpaired_depth"] == 1


def test_frame_of_a_node_without_depth_is_given_so_that_the_renderer_can_say_what_it_lacks() -> None:
    assembler = FrameAssembler(PairingSettings(patience_ms=100))
    add(assembler, color(1, START, START), pose(1, START))
    assert assembler.take(START + 99 * MS) is None
    frame = assembler.take(START + 100 * MS)
    assert frame is not None
    assert frame.view.depth is None


def test_nearest_depth_is_chosen() -> None:
    assembler = FrameAssembler()
    add(
        assembler,
        depth(1, START - 15 * MS, 1.0),
        depth(2, START + 10 * MS, 2.0),
        depth(3, START + 18 * MS, 3.0),
    )
    add(assembler, color(9, START, START), pose(9, START))
    frame = assembler.take(START)
    assert frame is not None
    assert frame.view.depth is not None
    assert frame.view.depth.depth_m[0, 0] == pytest.approx(2.0)


def test_board_not_seen_is_a_frame_without_pose_and_not_unpaired() -> None:
    assembler = FrameAssembler(needs_depth=False)
    add(assembler, color(1, START, START), pose(1, START, "no_board"))
    frame = assembler.take(START)
    assert frame is not None
    assert frame.view.pose is None
    assert assembler.counts["unpaired_pose"] == 0


def test_camera_is_built_once_while_it_does_not_change() -> None:
    assembler = FrameAssembler(needs_depth=False)
    frames = []
    for number in (1, 2):
        add(assembler, color(number, START + number, START), pose(number, START + number))
        frames.append(assembler.take(START))
    assert frames[0] is not None
    assert frames[1] is not None
    assert frames[0].view.camera is frames[1].view.camera


def test_broken_payload_is_refused_once_and_the_next_frame_goes_on() -> None:
    assembler = FrameAssembler(needs_depth=False)
    broken = color(1, START, START)
    message, _ = decode(broken)
    jpeg = message.model_copy(update={"encoding": "jpeg"})
    assembler.add(jpeg, [memoryview(b"no jpeg at all")], START)
    add(assembler, pose(1, START))
    with pytest.raises(EnvelopeError):
        assembler.take(START)
    assert assembler.take(START) is None
    add(assembler, color(2, START + MS, START), pose(2, START + MS))
    assert assembler.take(START) is not None


def test_history_is_bounded() -> None:
    assembler = FrameAssembler(needs_depth=False)
    for number in range(1000):
        add(assembler, color(number, START + number, START))
    assert assembler.counts["superseded"] >= 990
