"""The documentation's pictures of the demo, of the tutorial's steps, and of one scene by every method.

python -m deltalight.benchmarks.docs_pictures demo tutorial animation
deltalight bench quality --scenes tabletop --methods dvct,dlpv,... --out FOLDER
python -m deltalight.benchmarks.docs_pictures methods --report FOLDER
"""

import argparse
import json
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

import deltalight as dl
from deltalight.protocol.files import write_bytes
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.services.demo import RECORDING, demo_scene

ROOT = Path(__file__).resolve().parents[1]
TUTORIAL = ROOT / "docs" / "first-relight.md"
FIGURE = RECORDING.with_name("figure.json")
VIEWS = "composite", "effects", "delta", "volume", "rsm"
WRONG_LAMP_M = (-0.3, 0.5, 0.9)  # the tutorial's "Break it"
STEPS = 0, 6, 12, 18  # frames of the walking figure
METHODS = {
    "truth (path traced)": "truth",
    "dvct": "dvct-result",
    "dlpv": "dlpv-result",
    "aroof": "aroof-result",
    "none": "none-result",
    "differential": "differential-result",
    "dvct, operator: paper": "paper-result",
    "dlpv, operator: paper": "dlpv-operator-paper-result",
}
JPEG_QUALITY = 88
GAP_PX, CAPTION_PX = 6, 22

Picture = UInt8[np.ndarray, "h w 3"]
Named = Iterator[tuple[str, Picture]]
"""Names of files below docs/images, and the pictures (RGB)."""


def rendered(scene: SceneDocument, *numbers: int, **output: object) -> list[Picture]:
    """Renders frames of the demo's recording; `output` replaces keys of the scene's output."""
    take = dl.open(RECORDING)
    assert isinstance(take, dl.Take)
    shown = dl.Scene(scene.replaced(output=scene.output.replaced(**output)))
    with dl.Renderer() as renderer:
        return [renderer.render(take[number], shown).color for number in numbers]


def demo_pictures() -> Named:
    """Renders the demo's first frame in the views that need nothing else."""
    for view in VIEWS:
        (picture,) = rendered(demo_scene("dvct"), 0, view=view)
        yield f"view_{view}.jpg", picture
        if view == "composite":
            yield "demo.png", picture


def tutorial_pictures() -> Named:
    """Renders the steps of the page from the scene that it shows."""
    (written,) = re.findall(r"```json\n(.*?)```", TUTORIAL.read_text(), re.DOTALL)
    keys = json.loads(written)
    for item in keys["objects"]:
        item["asset"] = str(ROOT / item["asset"])
    for name, view in (("relit", "composite"), ("delta", "delta")):
        (picture,) = rendered(parse_scene(keys), 0, view=view)
        yield f"tutorial_{name}.jpg", picture
    keys["lights"]["manual"][0]["position_m"] = WRONG_LAMP_M
    (picture,) = rendered(parse_scene(keys), 0)
    yield "tutorial_wrong_lamp.jpg", picture


def animation_pictures() -> Named:
    """Renders four frames of the figure that walks."""
    figure = dl.Scene.load(FIGURE).document
    yield "animation.jpg", grid(rendered(figure, *STEPS, width=400, height=300), columns=2)


def methods_pictures(report: Path) -> Named:
    """Puts together the pictures that `bench quality` wrote into the folder `report`."""
    cells = [
        captioned(_read(report / "pictures" / f"tabletop-{name}.png"), text) for text, name in METHODS.items()
    ]
    yield "methods.jpg", grid(cells, columns=4)


def captioned(picture: Picture, text: str) -> Picture:
    """Returns the picture below a line of text."""
    line = np.full((CAPTION_PX, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(line, text, (4, CAPTION_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([line, picture])


def grid(pictures: list[Picture], columns: int) -> Picture:
    """Returns pictures of one size in rows, with gaps between them."""
    height, width = (size + GAP_PX for size in pictures[0].shape[:2])
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * height - GAP_PX, columns * width - GAP_PX, 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = number // columns * height, number % columns * width
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def _read(file: Path) -> Picture:
    picture = cv2.imread(str(file))
    if picture is None:
        raise SystemExit(f"{file} is missing; see --help for the command that writes it.")
    return np.asarray(picture[..., ::-1], np.uint8)


def _write(file: Path, picture: Picture) -> None:
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if file.suffix == ".jpg" else []
    _, encoded = cv2.imencode(file.suffix, picture[..., ::-1], quality)
    write_bytes(file, encoded.tobytes())
    print(file)


def main() -> None:
    """Writes the pictures."""
    made = {"demo": demo_pictures, "tutorial": tutorial_pictures, "animation": animation_pictures}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("which", nargs="+", choices=[*made, "methods"], help="Which pictures.")
    parser.add_argument("--report", type=Path, help="Folder of `bench quality --out`, for `methods`.")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images", help="Folder to write into.")
    arguments = parser.parse_args()
    if "methods" in arguments.which:
        if arguments.report is None:
            parser.error("`methods` needs --report.")
        made["methods"] = lambda: methods_pictures(arguments.report)
    for which in arguments.which:
        for name, picture in made[which]():
            _write(arguments.out / name, picture)


if __name__ == "__main__":
    main()
