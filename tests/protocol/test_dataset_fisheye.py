"""Fish-eye pictures of dataset folders: which hold when, what they are decoded to, what is refused."""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset import DatasetReader, open_dataset
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import save_fisheye_yaml
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.protocol.radiance_files import write_exr
from tests.protocol.fisheye_samples import (
    HEIGHT,
    WIDTH,
    assert_same_pictures,
    calibration,
    coded,
    equidistant,
    linear,
    uncoded_response,
)

MS = 1_000_000


def frames(*fisheyes: FisheyePictures | None, period_ns: int = 100 * MS) -> list[SensorFrame]:
    camera = CameraModel(8, 6, np.array([[7.0, 0, 3.5], [0, 7.0, 2.5], [0, 0, 1]]))
    color = np.zeros((6, 8, 3), np.uint8)
    return [
        SensorFrame(index, 1_000 * MS + index * period_ns, color, camera, fisheye=fisheye)
        for index, fisheye in enumerate(fisheyes)
    ]


def written(folder: Path, *fisheyes: FisheyePictures | None) -> DatasetReader:
    with DatasetWriter(folder) as writer:
        for frame in frames(*fisheyes):
            writer.add(frame)
            open_dataset(folder)  # readable after every frame
    return open_dataset(folder)


def test_what_is_written_is_read_again_to_the_bit(tmp_path: Path) -> None:
    first, second = coded(1_000 * MS), coded(1_150 * MS)
    reader = written(tmp_path / "a", first, first, second, second)
    read = [frame.fisheye for frame in reader]
    for ours, theirs in zip(read, (first, first, second, second), strict=True):
        assert_same_pictures(ours, theirs)
    assert read[0] is read[1]
    assert read[2] is read[3]
    assert len(list((tmp_path / "a" / "fisheye").iterdir())) == 6, "pictures that hold are written once"
    assert not any("fish-eye" in note or "fisheye" in note for note in reader.notes)


def test_linear_pictures_of_an_ocam_lens_come_back_to_the_bit(tmp_path: Path) -> None:
    single, bracket = linear(1_000 * MS), linear(1_100 * MS, (0.5, 0.01))
    reader = written(tmp_path / "a", single, bracket)
    assert_same_pictures(reader[0].fisheye, single)
    assert_same_pictures(reader[1].fisheye, bracket)


def test_pictures_hold_until_the_next_and_the_first_also_before_it(tmp_path: Path) -> None:
    reader = written(tmp_path / "a", None, coded(1_150 * MS), None)
    times = [None if frame.fisheye is None else frame.fisheye.timestamp_ns for frame in reader]
    assert times == [1_150 * MS] * 3
    reader = written(tmp_path / "b", coded(1_000 * MS), coded(1_101 * MS), None)
    times = [None if frame.fisheye is None else frame.fisheye.timestamp_ns for frame in reader]
    assert times == [1_000 * MS, 1_000 * MS, 1_101 * MS]


def with_picture(folder: Path, name: str) -> Path:
    """A dataset whose only fish-eye picture is a file called `name`, of the sRGB-coded sample camera."""
    written(folder, uncoded_response(coded(1_000 * MS, (None,))))
    (folder / "fisheye.txt").write_text(f"1.0 fisheye/{name}\n")
    return folder / "fisheye" / name


def fisheye_of(folder: Path) -> FisheyePictures:
    pictures = open_dataset(folder)[0].fisheye
    assert pictures is not None
    return pictures


@pytest.mark.parametrize("suffix", ["hdr", "exr"])
def test_hdr_and_exr_are_linear_rgb(tmp_path: Path, suffix: str) -> None:
    path = with_picture(tmp_path / "a", f"sun.{suffix}")
    radiance = np.full((HEIGHT, WIDTH, 3), (1000.0, 2.0, 0.25), np.float32)
    if suffix == "hdr":
        cv2.imwrite(str(path), radiance[..., ::-1])
    else:
        radiance[0, 0] = -0.01  # as lossy compression leaves it
        write_exr(path, radiance)
    (picture,) = fisheye_of(tmp_path / "a").pictures
    assert picture.dtype == np.float32
    # The shared exponent of .hdr leaves 8 bits to the brightest channel only.
    assert picture[5, 5] == pytest.approx([1000, 2.0, 0.25], abs=5 if suffix == "hdr" else 0)
    assert picture.min() >= 0


def test_jpeg_is_coded_rgb(tmp_path: Path) -> None:
    path = with_picture(tmp_path / "a", "sky.jpg")
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), (10, 100, 200), np.uint8))
    (picture,) = fisheye_of(tmp_path / "a").pictures
    assert picture.dtype == np.uint8
    assert picture[5, 5].tolist() == pytest.approx([200, 100, 10], abs=4)


def test_response_file_goes_before_the_one_in_the_calibration(tmp_path: Path) -> None:
    reader = written(tmp_path / "a", coded(1_000 * MS))
    table = np.linspace(0, 1, 768, dtype=np.float32).reshape(256, 3)
    np.savetxt(tmp_path / "a" / "fisheye_response.txt", table, fmt="%.9g")
    assert reader[0].fisheye is not None
    assert np.array_equal(
        np.asarray(reader[0].fisheye.calibration.response), np.asarray(calibration().response)
    )
    found = fisheye_of(tmp_path / "a").calibration
    assert np.array_equal(np.asarray(found.response), table)
    assert found.lens.to_dict() == equidistant().to_dict()


def test_pictures_without_calibration_are_said_once_and_not_used(tmp_path: Path) -> None:
    written(tmp_path / "a", coded(1_000 * MS))
    (tmp_path / "a" / "calibration" / "fisheye.yaml").unlink()
    reader = open_dataset(tmp_path / "a")
    assert reader[0].fisheye is None
    assert sum("no calibration/fisheye.yaml; they are not used" in note for note in reader.notes) == 1


def test_bad_fisheye_folders_are_told_in_one_sentence(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    path = with_picture(folder, "sky.png")
    bad_pictures = [
        (np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8), r"sky\.png has 41x36 pixels but calibration/fisheye"),
        (None, r"sky\.png cannot be decoded"),
    ]
    for picture, message in bad_pictures:
        path.write_bytes(b"" if picture is None else cv2.imencode(".png", picture)[1].tobytes())
        with pytest.raises(DeltalightError, match=message):
            open_dataset(folder)
    for name in ("sky.hdr", "sky.exr"):
        (folder / "fisheye" / name).write_bytes(b"no picture")
        (folder / "fisheye.txt").write_text(f"1.0 fisheye/{name}\n")
        with pytest.raises(DeltalightError, match=rf"{name} cannot be read as"):
            open_dataset(folder)
    write_exr(folder / "fisheye" / "sky.exr", np.full((HEIGHT, WIDTH, 3), np.inf, np.float32))
    with pytest.raises(DeltalightError, match="not finite"):
        open_dataset(folder)
    write_exr(folder / "fisheye" / "sky.exr", np.ones((HEIGHT, WIDTH, 3), np.float32))
    (folder / "fisheye.txt").write_text("1 fisheye/sky.exr 0.1\n1 fisheye/000000-0.png 0.2\n")
    with pytest.raises(DeltalightError, match="mixes linear and coded"):
        open_dataset(folder)
    (folder / "calibration" / "fisheye.yaml").write_text("image_width: 4\n")
    with pytest.raises(DeltalightError, match=r"fisheye\.yaml"):
        open_dataset(folder)


def test_writing_refuses_what_cannot_be_read_again(tmp_path: Path) -> None:
    first = coded(1_000 * MS)
    bad = [
        (coded(1_100 * MS, (0.1, None)), "lacks exposures"),
        (coded(900 * MS), "earlier than the one before"),
        (uncoded_response(coded(1_100 * MS)), "calibration changed"),
    ]
    for index, (second, message) in enumerate(bad):
        with pytest.raises(DeltalightError, match=message):
            written(tmp_path / str(index), first, second)
        assert len(open_dataset(tmp_path / str(index))) == 1
    held = replace(first, pictures=())  # known by its time, so it is not looked at again
    assert_same_pictures(written(tmp_path / "held", first, held)[1].fisheye, first)


def test_calibration_file_of_a_pinhole_lens_is_refused(tmp_path: Path) -> None:
    written(tmp_path / "a", coded(1_000 * MS))
    save_fisheye_yaml(tmp_path / "b.yaml", calibration())
    text = (tmp_path / "b.yaml").read_text().replace("equidistant", "plumb_bob")
    (tmp_path / "a" / "calibration" / "fisheye.yaml").write_text(text)
    with pytest.raises(DeltalightError, match="plumb_bob"):
        open_dataset(tmp_path / "a")


def test_linear_pictures_without_openexr_are_told_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = with_picture(tmp_path / "a", "sun.exr")
    write_exr(path, np.ones((HEIGHT, WIDTH, 3), np.float32))
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(
        DeltalightError, match=r"sun\.exr needs the package OpenEXR: .* -m pip install OpenEXR"
    ):
        open_dataset(tmp_path / "a")
    with pytest.raises(DeltalightError, match=r"writing .*000000-0\.exr needs the package OpenEXR"):
        written(tmp_path / "b", linear(1_000 * MS))
