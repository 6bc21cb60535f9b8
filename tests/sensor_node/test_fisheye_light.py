"""View frames carry the light that fish-eye pictures and lamp markers show."""

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.protocol.board import LampMarker
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from tests.sensor_node.fisheye_samples import bracket, equidistant

LENS = equidistant(64)


class Rig(SyntheticCamera):
    """The synthetic camera with a fish-eye camera beside it."""

    def __init__(self, **known: Float64[np.ndarray, "4 4"]) -> None:
        super().__init__()
        self.extrinsics = Extrinsics(**known)


def shift(x: float, y: float, z: float) -> Float64[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def light(level: float, exposures_s: tuple[float | None, ...] = (1.0, 0.1)) -> FisheyePictures:
    return bracket(np.full((64, 64, 3), level), exposures_s, LENS)


def frame_of(rig: Rig, number: int, pictures: FisheyePictures | None) -> SensorFrame:
    return replace(rig.frame_at(number), fisheye=pictures, world_from_camera=rig.pose_at(number))


def test_a_fixed_probe_has_its_own_pose_and_one_map_as_long_as_its_pictures_hold() -> None:
    rig = Rig(world_from_fisheye=shift(0.1, 0.2, 0.3))
    builder = ViewFrameBuilder(rig)
    first, second = light(0.5), light(2.0)
    views = [builder(frame_of(rig, n, pictures)) for n, pictures in enumerate((first, first, second))]
    maps = [view.radiance_map for view in views]
    assert maps[0] is not None
    assert maps[0] is maps[1]
    assert maps[2] is not None
    np.testing.assert_array_equal(maps[0].world_from_fisheye, shift(0.1, 0.2, 0.3))
    assert maps[0].radiance.mean() == pytest.approx(0.5, rel=0.02)
    assert maps[2].radiance.mean() == pytest.approx(2.0, rel=0.02)
    assert builder.notes == []


def test_units_stay_those_of_the_first_bracket() -> None:
    rig = Rig(world_from_fisheye=np.eye(4))
    builder = ViewFrameBuilder(rig)
    brackets = light(0.5, (1.0, 0.1)), light(0.5, (0.25, 0.1)), light(0.5, (0.5,))
    levels = []
    for number, pictures in enumerate(brackets):
        radiance = builder(frame_of(rig, number, pictures)).radiance_map
        assert radiance is not None
        levels.append(radiance.radiance.mean())
    assert levels == pytest.approx([0.5] * 3, rel=0.02)


def test_a_moving_rig_keeps_the_pose_at_which_its_pictures_were_taken() -> None:
    rig = Rig(rgb_from_fisheye=shift(0.0, -0.05, 0.0))
    builder = ViewFrameBuilder(rig)
    pictures, later = light(0.5), light(0.5)
    views = [builder(frame_of(rig, n, taken)) for n, taken in ((0, pictures), (5, pictures), (9, later))]
    for view, number in zip(views, (0, 0, 9), strict=True):
        assert view.radiance_map is not None
        expected = rig.pose_at(number) @ shift(0.0, -0.05, 0.0)
        assert view.radiance_map.world_from_fisheye == pytest.approx(expected)


class Sequence:
    """A source of frames 0 to 4 of a moving rig, whose only fish-eye pictures were taken with frame 2."""

    board = scene = depth_scale = None
    notes: ClassVar[list[str]] = []

    def __init__(self, rig: Rig) -> None:
        self.camera, self.extrinsics = rig.camera, rig.extrinsics
        self.timestamps_ns = [rig.frame_at(number).timestamp_ns for number in range(5)]
        pictures = replace(light(0.5), timestamp_ns=self.timestamps_ns[2])
        self._frames = [frame_of(rig, number, pictures) for number in range(5)]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> SensorFrame:
        return self._frames[index]

    def __iter__(self) -> Iterator[SensorFrame]:
        return iter(self._frames)


def test_a_map_does_not_depend_on_where_a_run_begins() -> None:
    rig = Rig(rgb_from_fisheye=np.eye(4))
    source = Sequence(rig)
    for first in (0, 2, 4):
        radiance = ViewFrameBuilder(source)(source[first]).radiance_map
        assert radiance is not None
        assert radiance.world_from_fisheye == pytest.approx(rig.pose_at(2))


def test_a_map_waits_until_the_pose_of_the_rig_is_known() -> None:
    rig = Rig(rgb_from_fisheye=np.eye(4))
    builder = ViewFrameBuilder(rig)
    pictures = light(0.5)
    blind = replace(rig.frame_at(0), color=np.full((480, 640, 3), 90, np.uint8), fisheye=pictures)
    assert builder(blind).radiance_map is None
    assert builder(frame_of(rig, 1, pictures)).radiance_map is not None


def test_an_unknown_place_is_said_once() -> None:
    rig = Rig()
    builder = ViewFrameBuilder(rig)
    for number in range(3):
        assert builder(frame_of(rig, number, light(0.5))).radiance_map is None
    assert len(builder.notes) == 1
    assert "give `world_from_fisheye`" in builder.notes[0]


def test_scenes_with_lights_of_their_own_do_not_pay() -> None:
    rig = Rig(world_from_fisheye=np.eye(4))
    # Pictures that would be refused if anything looked at them.
    broken = replace(light(0.5), pictures=(np.zeros((3, 3, 3), np.uint8),))
    view = ViewFrameBuilder(rig, needs_light=False)(frame_of(rig, 0, broken))
    assert view.radiance_map is None
    assert view.lamps == ()


def test_lamp_markers_come_with_the_view_and_cost_nothing_where_none_is_named() -> None:
    """The synthetic sheet's last marker plays the lamp: it lies flat on the sheet, in the sheet's axes."""
    rig = Rig()
    sheet = rig.board
    assert sheet is not None
    frame = frame_of(rig, 0, None)
    assert ViewFrameBuilder(rig)(frame).lamps == ()
    rig.board = sheet.replaced(rows=2, lamp_markers=(LampMarker(id=11, marker_length_m=0.05),))
    lamps = ViewFrameBuilder(rig)(frame).lamps
    assert [lamp.marker for lamp in lamps] == [11]
    expected = sheet.corner_points()[11].mean(axis=0)
    assert lamps[0].world_from_marker[:3, 3] == pytest.approx(expected, abs=0.003)
    assert ViewFrameBuilder(rig, needs_light=False)(frame).lamps == ()
    unseen = replace(frame, world_from_camera=None, color=np.full((480, 640, 3), 90, np.uint8))
    assert ViewFrameBuilder(rig)(unseen).lamps == ()


def test_frames_without_a_fisheye_have_no_map() -> None:
    rig = Rig(world_from_fisheye=np.eye(4))
    builder = ViewFrameBuilder(rig)
    assert builder(frame_of(rig, 0, None)).radiance_map is None
    assert builder.notes == []
