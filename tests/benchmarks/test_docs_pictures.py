"""The documentation's pictures: what they are rendered from, and how they are put together."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.benchmarks import docs_pictures
from deltalight.benchmarks.docs_pictures import GAP_PX, METHODS, Picture, captioned, grid
from deltalight.protocol.scene import SceneDocument
from deltalight.services.demo import RECORDING

GREY = np.full((12, 16, 3), 90, np.uint8)


def test_a_grid_holds_its_pictures_in_rows() -> None:
    pictures = [np.full((12, 16, 3), 10 * number, np.uint8) for number in range(5)]
    sheet = grid(pictures, columns=2)
    assert sheet.shape == (3 * 12 + 2 * GAP_PX, 2 * 16 + GAP_PX, 3)
    for number, picture in enumerate(pictures):
        top, left = number // 2 * (12 + GAP_PX), number % 2 * (16 + GAP_PX)
        assert np.array_equal(sheet[top : top + 12, left : left + 16], picture)
    assert (sheet[12 : 12 + GAP_PX] == 255).all()
    assert (sheet[-12:, 16:] == 255).all(), "there is no sixth picture"


def test_a_caption_stands_above() -> None:
    shown = captioned(GREY, "dvct")
    line = shown[: -len(GREY)]
    assert np.array_equal(shown[-len(GREY) :], GREY)
    assert line.max() == 255
    assert line.min() < 128


def test_the_tutorials_pictures_come_from_the_scene_of_its_page(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes: list[tuple[SceneDocument, dict[str, object]]] = []

    def rendered(scene: SceneDocument, *_numbers: int, **output: object) -> list[Picture]:
        scenes.append((scene, output))
        return [GREY]

    monkeypatch.setattr(docs_pictures, "rendered", rendered)
    names = [name for name, _ in docs_pictures.tutorial_pictures()]
    page = docs_pictures.TUTORIAL.read_text()
    assert all(f"images/{name}" in page for name in names)
    assert [output.get("view") for _, output in scenes] == ["composite", "delta", None]
    (figure,) = {str(item.asset) for scene, _ in scenes for item in scene.objects}
    assert Path(figure) == RECORDING.with_name("figure.glb")
    right, _, wrong = (scene.lights.manual[0] for scene, _ in scenes)
    assert f'"position_m": {list(wrong.position_m)}' in page  # type: ignore[union-attr]
    assert wrong.replaced(position_m=right.position_m) == right  # type: ignore[union-attr]


def test_methods_are_those_of_a_report(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    with pytest.raises(SystemExit, match=r"tabletop-truth\.png is missing; see --help"):
        next(docs_pictures.methods_pictures(tmp_path))
    for name in METHODS.values():
        cv2.imwrite(str(tmp_path / "pictures" / f"tabletop-{name}.png"), GREY)
    ((name, sheet),) = docs_pictures.methods_pictures(tmp_path)
    assert name == "methods.jpg"
    assert sheet.shape[1] == 4 * 16 + 3 * GAP_PX


def test_methods_need_a_report(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["docs_pictures", "methods"])
    with pytest.raises(SystemExit):
        docs_pictures.main()
    assert "`methods` needs --report." in capsys.readouterr().err
