"""Khronos' sample models beside their authors' pictures: on folders of the same layout."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.benchmarks.khronos_samples import EDGE, GROUND, samples_of, write_pairs
from deltalight.protocol.errors import DeltalightError

RED, SCREENSHOT_RED = (0.8, 0.0, 0.0, 1.0), (200, 0, 0)


def add(folder: Path, name: str, layout: str, screenshot: tuple[int, int] | None = None) -> Path:
    """A model of a large red plate far from the origin; its file's path. `screenshot`: of that width and height."""
    inside = folder / name / layout
    inside.mkdir(parents=True)
    plate = Plate(200.0, 100.0)
    plate.material["pbrMetallicRoughness"] = {"baseColorFactor": RED, "metallicFactor": 0}
    plate.glb.document["extensionsUsed"] = ["KHR_materials_iridescence"]
    if screenshot is not None:
        pictures = folder / name / "screenshot"
        pictures.mkdir()
        codes = np.full((screenshot[1], screenshot[0], 3), SCREENSHOT_RED[::-1], np.uint8)
        cv2.imwrite(str(pictures / "screenshot.png"), codes)
    return plate.write(inside / f"{name}.glb", {"translation": [1000, 2000, 3000]})


def test_each_model_is_drawn_beside_its_screenshot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The model fills the picture's width, in the middle, and a broken one does not keep the others from it."""
    folder, out = tmp_path / "2.0", tmp_path / "out"
    add(folder, "Broken", "glTF-Binary").write_bytes(b"glTF")
    add(folder, "Plate", "glTF-Binary", (100, 50))
    (folder / "Unrelated").mkdir()
    write_pairs(folder, out)
    broken, plate = capsys.readouterr().out.splitlines()
    assert broken.startswith("1/2 Broken: refused: ")
    assert plate.startswith("2/2 Plate: drawn in part: ")
    assert plate.endswith("is shown without KHR_materials_iridescence.")
    written = cv2.imread(str(out / "Plate.png"))
    assert written is not None
    pair = written[..., ::-1].astype(int)
    assert pair.shape[0] == EDGE
    drawn, screenshot = pair[:, :EDGE], pair[:, EDGE:]
    redness = drawn[..., 0] - drawn[..., 1] > 60
    assert redness.any(axis=0).mean() == pytest.approx(0.95, abs=0.02)
    assert redness.any(axis=1).mean() == pytest.approx(0.475, abs=0.02)
    assert np.argwhere(redness).mean(axis=0) == pytest.approx([(EDGE - 1) / 2] * 2, abs=1)
    assert drawn[0, 0] == pytest.approx([GROUND] * 3, abs=1)
    assert screenshot[0, 0] == pytest.approx(SCREENSHOT_RED)
    sheet = cv2.imread(str(out / "sheet.png"))
    assert sheet is not None
    assert sheet.shape[0] == EDGE


def test_models_of_either_layout_are_found_by_name(tmp_path: Path) -> None:
    add(tmp_path, "One", "glTF-Binary")
    other = add(tmp_path, "Other", "glTF", (10, 10))
    other.rename(other.with_suffix(".gltf"))
    assert [sample.name for sample in samples_of(tmp_path)] == ["One", "Other"]
    (chosen,) = samples_of(tmp_path, ["Other"])
    assert chosen.model.suffix == ".gltf"
    assert chosen.screenshot is not None


@pytest.mark.parametrize("names", [[], ["Missing"]])
def test_a_folder_without_the_models_is_refused(tmp_path: Path, names: list[str]) -> None:
    if names:
        add(tmp_path, "One", "glTF-Binary")
    with pytest.raises(DeltalightError, match=r"give 2\.0 of glTF-Sample-Models"):
        samples_of(tmp_path, names)
