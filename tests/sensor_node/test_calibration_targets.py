"""Targets and views: what is found in pictures, which pictures of a series are taken, where they come from."""

from collections.abc import Generator
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import UInt8

from deltalight.protocol.board import BoardSpec, save_board_yaml
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.calibration.picture_sources import MOST_VIEWS, Series, collect_views, open_series
from deltalight.sensor_node.calibration.targets import Chessboard, MarkerBoard, Sighting, parse_target
from deltalight.sensor_node.calibration.views import Picture, ViewCollector
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from tests.sensor_node.calibration_samples import BOARD, facing, picture

CAMERA = CameraModel(
    400,
    300,
    np.array([[330.0, 0, 199.5], [0, 330.0, 149.5], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.2, 0.05, 0, 0, 0]),
)
MIDDLE = BOARD.points.mean(axis=0)


def shot(towards: tuple[float, float], tilt: tuple[float, float] = (0.3, 0.2)) -> Picture:
    return Picture("shot", picture(CAMERA, facing(MIDDLE, towards, tilt, 0.55, 0.1)), 0)


def test_chessboard_corners_are_true_to_a_tenth_of_a_pixel() -> None:
    pose = facing(MIDDLE, (0.1, -0.05), (0.4, -0.3), 0.5, 0.2)
    found = BOARD.find(cv2.cvtColor(picture(CAMERA, pose), cv2.COLOR_RGB2GRAY))
    assert found is not None
    truth = CAMERA.project(BOARD.points @ pose[:3, :3].T + pose[:3, 3])
    # The board may be taken from its other end: the nearest corner counts.
    misses = np.linalg.norm(found.pixels[:, None] - truth[None], axis=-1).min(axis=1)
    assert np.sqrt(np.mean(misses**2)) < 0.1
    assert len(found.numbers) == 48


def test_markers_are_found_better_once_the_lens_is_known() -> None:
    synthetic = SyntheticCamera(camera=CAMERA)
    assert synthetic.board is not None
    target = MarkerBoard(synthetic.board)
    errors: dict[str, list[np.ndarray]] = {"found": [], "refined": []}
    for index in (0, 20, 50):
        gray = cv2.cvtColor(synthetic.frame_at(index).color, cv2.COLOR_RGB2GRAY)
        found = target.find(gray)
        assert found is not None
        pose = synthetic.pose_at(index)
        truth = CAMERA.project((target.points[found.numbers] - pose[:3, 3]) @ pose[:3, :3])
        for name, sighting in (("found", found), ("refined", target.refined(gray, found, CAMERA))):
            errors[name].append(np.linalg.norm(sighting.pixels - truth, axis=1))
    found_rms, refined_rms = (float(np.sqrt(np.mean(np.concatenate(each) ** 2))) for each in errors.values())
    assert refined_rms < 0.12
    assert refined_rms < found_rms < 0.4


def test_charuco_corners_have_the_numbers_of_the_board() -> None:
    board = {
        "type": "charuco",
        "dictionary": "DICT_5X5_50",
        "marker_length_m": 0.03,
        "separation_m": 0.01,
        "rows": 5,
        "columns": 7,
    }
    synthetic = SyntheticCamera(BoardSpec.model_validate(board))
    assert synthetic.board is not None
    target = MarkerBoard(synthetic.board)
    found = target.find(cv2.cvtColor(synthetic.frame_at(10).color, cv2.COLOR_RGB2GRAY))
    assert found is not None
    assert len(found.numbers) >= 20
    pose = synthetic.pose_at(10)
    truth = synthetic.camera.project((target.points[found.numbers] - pose[:3, 3]) @ pose[:3, :3])
    assert np.linalg.norm(found.pixels - truth, axis=1).max() < 0.5


def test_of_a_film_only_still_and_new_views_are_taken() -> None:
    collector = ViewCollector(BOARD, moving=True)
    places = [
        (-0.1, 0.0),
        (-0.1, 0.0),
        (-0.1, 0.0),
        (0.0, 0.0),
        (0.1, 0.0),
        (0.1, 0.0),
        (-0.1, 0.0),
        (-0.1, 0.0),
    ]
    taken = [collector.add(shot(place)) for place in places]
    # A moment is one scene: all shots here have moment 0, so each gets its own below.
    assert taken == [False, True, False, False, False, False, False, False]
    collector = ViewCollector(BOARD, moving=True)
    taken = [collector.add(shot(place)._replace(moment=number)) for number, place in enumerate(places)]
    assert taken == [False, True, False, False, False, True, False, False]


def test_of_a_bracket_one_exposure_is_taken() -> None:
    collector = ViewCollector(BOARD, moving=False)
    dark = Picture("dark", np.zeros((300, 400, 3), np.uint8), 5)
    good = shot((0.0, 0.0))._replace(moment=5)
    assert [collector.add(each) for each in (dark, good, good._replace(name="longer"))] == [
        False,
        True,
        False,
    ]
    assert [view.name for view in collector.views] == ["shot"]
    assert collector.brightest is not None
    assert collector.brightest.max() > 200


def test_pictures_of_two_sizes_are_refused() -> None:
    collector = ViewCollector(BOARD, moving=False)
    collector.add(shot((0.0, 0.0)))
    with pytest.raises(DeltalightError, match="one camera and one size"):
        collector.add(Picture("other.png", np.zeros((100, 200, 3), np.uint8), 1))


def test_ctrl_c_ends_a_live_series_with_what_there_is() -> None:
    def pictures() -> Generator[Picture]:
        yield shot((0.0, 0.0))
        yield shot((0.0, 0.0))
        raise KeyboardInterrupt

    told = []
    live = Series(pictures(), None, moving=True)
    collected = collect_views(live, BOARD, enough=20, tell=lambda _, taken: told.append(taken))
    assert told == [False, True]
    assert len(collected.views) == 1
    with pytest.raises(KeyboardInterrupt):
        collect_views(Series(pictures(), 3, moving=False), BOARD, enough=20, tell=lambda *_: None)


def test_a_live_series_ends_at_enough_views_and_a_long_one_is_thinned() -> None:
    target, here = BOARD, shot((0.0, 0.0))
    found = target.find(cv2.cvtColor(here.color, cv2.COLOR_RGB2GRAY))

    class Known(Chessboard):
        def find(self, gray: UInt8[np.ndarray, "h w"]) -> Sighting | None:
            del gray
            return found

    blank = np.zeros((300, 400, 3), np.uint8)
    many = [Picture(str(number), blank, number) for number in range(150)]
    known = Known(8, 6, 0.04)
    collected = collect_views(
        Series((each for each in many), 150, moving=False), known, enough=8, tell=lambda *_: None
    )
    assert 0.5 * MOST_VIEWS < len(collected.views) <= MOST_VIEWS
    assert int(collected.views[-1].name) > 140
    live = Series((each for each in many), None, moving=False)
    assert len(collect_views(live, known, enough=8, tell=lambda *_: None).views) == 8


def test_series_of_files_come_in_natural_order(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        cv2.imwrite(str(tmp_path / f"shot{number}.png"), np.full((30, 40, 3), number, np.uint8))
    cv2.imwrite(str(tmp_path / "other.png"), np.zeros((30, 40, 3), np.uint8))
    series = open_series(str(tmp_path / "shot*.png"), "rgb")
    assert [each.name for each in series.pictures] == ["shot1.png", "shot2.png", "shot10.png"]
    assert open_series(str(tmp_path), "rgb").total == 4
    assert not series.moving


def test_a_dataset_without_calibration_is_a_film_or_single_shots(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((30, 40, 3), np.uint8))
    (tmp_path / "rgb.txt").write_text("0.0 a.png\n0.1 b.png\n0.2 c.png\n")
    (tmp_path / "fisheye.txt").write_text("0 a.png 0.1\n0 b.png 0.01\n9 c.png\n")
    film, shots = open_series(str(tmp_path), "rgb"), open_series(str(tmp_path), "fisheye")
    assert film.moving
    assert not shots.moving
    assert [each.moment for each in shots.pictures] == [0, 0, 9 * 10**9]


def test_a_live_camera_needs_no_calibration_and_is_closed_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    from deltalight.sensor_node.cameras import open as opening

    asked: list[tuple[str, dict[str, bool]]] = []
    closed: list[bool] = []

    class Known(SyntheticCamera):
        def close(self) -> None:
            closed.append(True)
            super().close()

    def open_camera(source: str, **options: bool) -> SyntheticCamera:
        asked.append((source, options))
        return Known()

    monkeypatch.setattr(opening, "open_camera", open_camera)
    series = open_series("uvc:0", "fisheye")
    assert series.total is None
    assert series.moving
    names = [next(series.pictures).name for _ in range(2)]
    assert names == ["frame 0", "frame 1"]
    assert asked == [("uvc:0", {"calibrated": False, "depth": False})]
    series.pictures.close()
    assert closed == [True]


def test_a_recording_gives_its_frames_and_its_board(tmp_path: Path, synthetic: SyntheticCamera) -> None:
    from deltalight.protocol.recording_writer import RecordingWriter

    frames = [synthetic.frame_at(index) for index in range(2)]
    with RecordingWriter(tmp_path / "take.mcap", board=synthetic.board) as writer:
        for frame in frames:
            writer.add(frame)
    series = open_series(str(tmp_path / "take.mcap"), "rgb")
    assert series.board == synthetic.board
    assert series.moving
    assert series.total == 2
    assert [each.moment for each in series.pictures] == [frame.timestamp_ns for frame in frames]
    assert list(open_series(str(tmp_path / "take.mcap"), "fisheye").pictures) == []


@pytest.mark.parametrize(
    ("source", "sentence"),
    [("nowhere", "there is no folder"), ("empty", "holds no pictures"), ("empty/*.png", "holds no pictures")],
)
def test_a_source_without_pictures_is_a_sentence(tmp_path: Path, source: str, sentence: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DeltalightError, match=sentence):
        open_series(str(tmp_path / source), "rgb")


@pytest.mark.parametrize("text", ["chessboard:8x6", "chessboard:2x6:0.1", "chessboard:8x6:0", "chessboard"])
def test_a_wrong_chessboard_is_a_sentence(text: str) -> None:
    with pytest.raises(DeltalightError, match="is not a chessboard"):
        parse_target(text, None, ())


def test_the_target_is_the_one_named_else_the_sources(tmp_path: Path, synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    with pytest.raises(DeltalightError, match="name the target with --target"):
        parse_target(None, None, (tmp_path, None))
    (tmp_path / "calibration").mkdir()
    save_board_yaml(tmp_path / "calibration" / "board.yaml", synthetic.board)
    target = parse_target(None, None, (None, tmp_path))
    assert isinstance(target, MarkerBoard)
    assert target.board == synthetic.board
    assert isinstance(parse_target("chessboard:8x6:0.04", synthetic.board, ()), Chessboard)
    assert isinstance(parse_target(None, synthetic.board, ()), MarkerBoard)
