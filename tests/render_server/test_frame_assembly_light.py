"""Light in the renderer's input: the map that holds, decoded once, and the lamps of the frame itself."""

from dataclasses import replace

import numpy as np
import pytest

from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import LampPose, ViewFrame
from deltalight.protocol.messages import RadianceMessage
from deltalight.render_server.server.frames import TOPICS, FrameAssembler
from deltalight.sensor_node.frame_messages import (
    Stamps,
    lamps_multipart,
    lights_multipart,
    radiance_multipart,
)
from tests.protocol.test_light_codecs import (
    assert_same_lights,
    assert_same_map,
    placed,
    sample_lights,
    sample_map,
)
from tests.services.conftest import color, pose, received

MS = 1_000_000
START = 1_000_000 * MS


def add(assembler: FrameAssembler, multipart: list[bytes]) -> None:
    message, parts = decode(received(multipart, START))
    assembler.add(message, parts, START)


def stamps(frame_id: int, capture_ns: int, node: str = "cam") -> Stamps:
    return Stamps(node=node, frame_id=frame_id, capture_ns=capture_ns, clock_offset_ns=0, clock_bound_ns=None)


def add_map(assembler: FrameAssembler, capture_ns: int, clipped_share: float, node: str = "cam") -> None:
    light = replace(sample_map(8), clipped_share=clipped_share)
    add(assembler, radiance_multipart(light, stamps(0, capture_ns, node), 90))


def add_lamps(assembler: FrameAssembler, frame_id: int, capture_ns: int, *x_m: float) -> None:
    lamps = [LampPose(40 + number, placed(x, 0, 0)) for number, x in enumerate(x_m)]
    add(assembler, lamps_multipart(lamps, stamps(frame_id, capture_ns)))


def view(assembler: FrameAssembler, frame_id: int, capture_ns: int) -> ViewFrame:
    add(assembler, [bytes(piece) for piece in pose(frame_id, capture_ns)])
    add(assembler, [bytes(piece) for piece in color(frame_id, capture_ns)])
    frame = assembler.take(START)
    assert frame is not None
    assert frame.view.frame_id == frame_id
    return frame.view


def share(assembler: FrameAssembler, frame_id: int, capture_ns: int) -> float | None:
    light = view(assembler, frame_id, capture_ns).radiance_map
    return None if light is None else light.clipped_share


def assembler_without_depth() -> FrameAssembler:
    return FrameAssembler(needs_depth=False)


def test_streams_of_light_are_subscribed() -> None:
    assert {"radiance", "lights", "lamps"} <= set(TOPICS)


def test_the_newest_map_that_is_not_later_holds() -> None:
    assembler = assembler_without_depth()
    assert share(assembler, 0, START - 100 * MS) is None
    add_map(assembler, START, 0.1)
    assert share(assembler, 1, START) == 0.1
    add_map(assembler, START + 100 * MS, 0.2)
    assert share(assembler, 2, START + 99 * MS) == 0.1
    assert share(assembler, 3, START + 100 * MS) == 0.2
    assert share(assembler, 4, START + 5000 * MS) == 0.2


def test_before_the_first_map_the_first_holds() -> None:
    assembler = assembler_without_depth()
    add_map(assembler, START + 200 * MS, 0.2)
    add_map(assembler, START + 100 * MS, 0.1)
    assert share(assembler, 1, START) == 0.1


def test_map_of_another_node_is_not_taken() -> None:
    assembler = assembler_without_depth()
    add_map(assembler, START, 0.1, node="other")
    assert share(assembler, 1, START) is None


def test_map_comes_whole_and_stays_the_same_object_while_it_holds() -> None:
    assembler = assembler_without_depth()
    light = sample_map(8)
    add(assembler, radiance_multipart(light, stamps(0, START), 90))
    first = view(assembler, 1, START).radiance_map
    assert first is not None
    assert_same_map(first, replace(light, timestamp_ns=START))
    for number in range(2, 12):  # sent again for those who come late
        add(assembler, radiance_multipart(light, stamps(0, START), 90))
        assert view(assembler, number, START + number * MS).radiance_map is first
    add_map(assembler, START + 20 * MS, 0.3)
    changed = view(assembler, 20, START + 20 * MS).radiance_map
    assert changed is not None
    assert changed is not first
    assert changed.calibration is first.calibration


def test_repeated_maps_do_not_push_out_the_one_that_holds() -> None:
    assembler = assembler_without_depth()
    add_map(assembler, START, 0.1)
    for _ in range(20):
        add_map(assembler, START + 100 * MS, 0.2)
    assert share(assembler, 1, START + 50 * MS) == 0.1


def test_maps_that_no_frame_takes_are_not_decoded() -> None:
    assembler = assembler_without_depth()
    message, parts = decode(radiance_multipart(sample_map(8), stamps(0, START), 90))
    broken = [memoryview(b"no chunk"), *parts[1:]]
    assembler.add(message, broken, START)
    add_map(assembler, START + MS, 0.2)
    assert share(assembler, 1, START + MS) == 0.2


def test_broken_map_costs_one_frame() -> None:
    assembler = assembler_without_depth()
    add_map(assembler, START, 0.1)
    message, parts = decode(radiance_multipart(sample_map(8), stamps(3, START + MS), 90))
    assert isinstance(message, RadianceMessage)
    assembler.add(message, [memoryview(b"no chunk"), *parts[1:]], START)
    with pytest.raises(DeltalightError):
        view(assembler, 1, START + MS)
    assert share(assembler, 2, START + 2 * MS) == 0.1


def add_lights(assembler: FrameAssembler, frame_id: int, capture_ns: int, size: int) -> None:
    own = stamps(frame_id, capture_ns)
    add(assembler, lights_multipart(sample_lights(size), own, own))


def test_lights_hold_like_maps_and_are_one_object_while_they_do() -> None:
    assembler = assembler_without_depth()
    assert view(assembler, 0, START - MS).sky_lights is None
    add_lights(assembler, 2, START, 8)
    first = view(assembler, 3, START + MS).sky_lights
    assert first is not None
    assert_same_lights(first, sample_lights(8))
    add_lights(assembler, 2, START, 8)  # again, for late subscribers
    assert view(assembler, 4, START + 2 * MS).sky_lights is first
    add_lights(assembler, 6, START + 9 * MS, 4)
    assert view(assembler, 5, START + 3 * MS).sky_lights is first
    second = view(assembler, 6, START + 9 * MS).sky_lights
    assert second is not None
    assert len(second.residual) == 4


def test_lamps_are_those_of_the_frame_itself_or_none() -> None:
    assembler = assembler_without_depth()
    add_lamps(assembler, 1, START, 0.25, -1.5)
    lamps = view(assembler, 1, START).lamps
    assert [lamp.marker for lamp in lamps] == [40, 41]
    assert np.array_equal(lamps[1].world_from_marker, placed(-1.5, 0, 0))
    assert view(assembler, 2, START + 33 * MS).lamps == ()
    add_lamps(assembler, 3, START, 0.5)  # that frame of an earlier round of a loop
    assert view(assembler, 3, START + 66 * MS).lamps == ()
    add_lamps(assembler, 4, START + 99 * MS)
    assert view(assembler, 4, START + 99 * MS).lamps == ()
