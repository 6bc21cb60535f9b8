"""Khronos' sample models, each as Deltalight draws it beside the screenshot of its authors.

    python -m deltalight.benchmarks.khronos_samples FOLDER OUT [NAME ...]

FOLDER is `2.0` of a checkout of glTF-Sample-Models or `Models` of glTF-Sample-Assets: it has a folder a model. With
names, only these models are drawn. OUT gets a picture a model and `sheet.png` with all of them.

Models are in their rest pose, flat ones seen from in front (glTF's +z), others from the right and above, in a room
with a sky, a dark ground and a window: its horizon shows whether mirror images are level. Screenshots have other
views and lights, so compare by eye.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from deltalight.benchmarks.measured_materials import FOCAL, SIDE, codes_of, drawn_document
from deltalight.benchmarks.relief_materials import latitude_longitude
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_png
from deltalight.protocol.poses import rotation_from_wxyz
from deltalight.render_server.scene.mesh_loading import load_asset

EDGE = 320  # pixels, of a picture
FILLED = 0.95  # of the picture's edge, at most
WHITE = 0.8  # of the sensor's, that a white surface shows which faces the camera
GROUND = 120  # code
FLAT = 0.3  # depth of a model that is seen from in front, over the longer of its other edges
# Turns that side to the viewer: by -35 degrees about y, then by 25 about x.
ABOVE_RIGHT = (0.931, 0.206, -0.294, -0.065)
COLUMNS = 3  # pairs side by side on the sheet
LAYOUTS = ("glTF-Binary/*.glb", "glTF/*.gltf", "*.glb", "*.gltf")


@dataclass(frozen=True)
class Sample:
    """A model's file, and its authors' picture if there is any."""

    name: str
    model: Path
    screenshot: Path | None


def samples_of(folder: Path, names: Sequence[str] = ()) -> list[Sample]:
    """Returns a folder's models by name; with `names`, only these.

    Raises:
        DeltalightError: there is no model, or none of a name.
    """
    found = list(_samples(folder))
    missing = set(names) - {sample.name for sample in found}
    if missing or not found:
        which = f"no model {', '.join(sorted(missing))}" if missing else "no folder with a glTF model"
        raise DeltalightError(
            f"{folder} has {which}; give 2.0 of glTF-Sample-Models or Models of glTF-Sample-Assets."
        )
    return [sample for sample in found if not names or sample.name in names]


def _samples(folder: Path) -> Iterator[Sample]:
    for inside in sorted(folder.glob("*/")):
        models = [path for layout in LAYOUTS for path in sorted(inside.glob(layout))]
        if models:
            yield Sample(
                inside.name, models[0], next(iter(sorted(inside.glob("screenshot/screenshot.*"))), None)
            )


def _radiance(d: Float64[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Returns a room's light from directions, y up, the camera at z: `WHITE` for a surface that faces it."""
    level = np.where(d[..., 1] > 0, 0.9 - 0.4 * d[..., 1], 0.25)
    window = (d[..., 2] > 0) & (abs(d[..., 0] + 0.5) < 0.2) & (abs(d[..., 1] - 0.55) < 0.2)
    level += 6.0 * window
    row = np.sqrt(np.maximum(0, 1 - d[..., 2] ** 2))  # of a latitude-longitude map about z, ∝ solid angle
    facing = np.maximum(d[..., 2], 0) * row
    white = (level * facing).sum() / facing.sum()
    return np.repeat((WHITE / white * level)[..., None], 3, axis=-1).astype(np.float32)


def _fitted(bounds: Float32[np.ndarray, "2 3"]) -> dict[str, Any]:
    """Returns the pose that puts a model before the camera of `drawn_document`."""
    low, high = bounds.astype(float)
    sides = high - low
    wxyz = (1.0, 0.0, 0.0, 0.0) if sides[2] < FLAT * sides[:2].max() else ABOVE_RIGHT
    turn = rotation_from_wxyz(wxyz)
    width, height, depth = abs(turn) @ sides
    half = FILLED * SIDE / FOCAL / 2  # of what the picture shows 1 m away
    scale = half / (max(width, height) / 2 + half * depth / 2)
    middle = scale * turn @ (low + high) / 2
    return {"scale": scale, "rotation_wxyz": wxyz, "translation_m": (-middle).tolist()}


def drawn(path: Path, room: Path) -> tuple[UInt8[np.ndarray, "h w 3"], str | None]:
    """Returns a model's picture in the light of a map, and what of the file is not shown.

    Raises:
        DeltalightError: the model is refused.
    """
    asset = load_asset(path)
    document = {
        "objects": [{"asset": str(path), "up_axis": "z", "pose": _fitted(asset.bounds)}],
        "lights": {"mode": "environment", "environment": {"map": str(room)}, "registration": [1, 1, 1]},
        "shading": {"name": "image_based"},
        "output": {"antialiasing": True},
    }
    linear = drawn_document(document, np.full((EDGE, EDGE, 3), GROUND, np.uint8))
    return codes_of(linear), asset.left_out


def _screenshot(path: Path | None) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the authors' picture, `EDGE` high, and at most half as wide again."""
    if path is None:
        return np.full((EDGE, EDGE, 3), GROUND, np.uint8)
    with Image.open(path) as picture:
        shown = picture.convert("RGBA")
        even = Image.new("RGBA", shown.size, (GROUND, GROUND, GROUND, 255))
        codes = np.asarray(Image.alpha_composite(even, shown).convert("RGB"))
    scale = min(EDGE / codes.shape[0], 1.5 * EDGE / codes.shape[1])
    height, width = (max(1, round(scale * edge)) for edge in codes.shape[:2])
    small = cv2.resize(codes, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.pad(small, ((0, EDGE - height), (0, 0), (0, 0))), np.uint8)


def _compared(sample: Sample, room: Path) -> tuple[str, UInt8[np.ndarray, "h w 3"]]:
    """Returns a line about a model, and its picture beside its authors'."""
    picture = np.full((EDGE, EDGE, 3), GROUND, np.uint8)
    try:
        picture, left_out = drawn(sample.model, room)
        said = f"drawn in part: {left_out}" if left_out else "drawn"
    except DeltalightError as error:
        said = f"refused: {error}"
    return f"{sample.name}: {said}", np.hstack([picture, _screenshot(sample.screenshot)])


def _sheet(pairs: Sequence[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns pictures in rows, each in a cell as wide as the widest."""
    width = max(pair.shape[1] for pair in pairs)
    cells = [np.pad(pair, ((0, 0), (0, width - pair.shape[1]), (0, 0))) for pair in pairs]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % COLUMNS)
    rows = [np.hstack(cells[at : at + COLUMNS]) for at in range(0, len(cells), COLUMNS)]
    return np.asarray(np.vstack(rows), np.uint8)


def write_pairs(folder: Path, out: Path, names: Sequence[str] = ()) -> None:
    """Writes the pictures; prints a line a model as soon as it is drawn.

    Raises:
        DeltalightError: there is no model, or none of a name.
    """
    samples = samples_of(folder, names)
    out.mkdir(parents=True, exist_ok=True)
    pairs = []
    with TemporaryDirectory() as name:
        room = Path(name) / "room.hdr"
        cv2.imwrite(str(room), _radiance(latitude_longitude()))
        for number, sample in enumerate(samples, 1):
            line, pair = _compared(sample, room)
            typer.echo(f"{number}/{len(samples)} {line}")
            write_png(out / f"{sample.name}.png", pair)
            pairs.append(pair)
    write_png(out / "sheet.png", _sheet(pairs))


def main(
    folder: Annotated[
        Path, typer.Argument(help="`2.0` of glTF-Sample-Models or `Models` of glTF-Sample-Assets.")
    ],
    out: Annotated[Path, typer.Argument(help="Folder of the pictures.")],
    names: Annotated[list[str] | None, typer.Argument(help="Models to draw; all, if none is named.")] = None,
) -> None:
    """Draws Khronos' sample models beside the screenshots of their authors."""
    try:
        write_pairs(folder, out, names or ())
    except DeltalightError as error:
        sys.stderr.write(f"{error}\n")
        raise typer.Exit(2) from None


if __name__ == "__main__":
    typer.run(main)
