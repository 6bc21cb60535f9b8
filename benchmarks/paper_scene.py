"""The papers' own scene as a dataset folder: `python -m deltalight.benchmarks.paper_scene DIRTCHAMBER_DATA OUT`.

DIRTCHAMBER_DATA is the `data` folder of the authors' release (photograph, marker, camera file, light settings,
Buddha). None of it is part of this project. docs/paper-scene.md describes the conversion.
"""

import json
import sys
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import numpy as np
import trimesh
import typer
from jaxtyping import Float64

from deltalight.protocol.board import BoardSpec, load_board_yaml
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.pictures import decode_rgb
from deltalight.sensor_node.markers import BoardDetector

MARKER_LENGTH_M = 0.08  # not published: sets the scale of the scene, nothing else depends on it
MARGIN_M = 0.011  # white paper around the marker, measured in the photograph against the marker
TABLE_M = (0.85, 0.6)  # visible part of the table, measured by the marker
TABLE_CENTRE_M = (-0.04, 0.005)
BUDDHA_HEIGHT_M = 0.2
# The light file gives only a direction. The window's size and the room's part are estimates from the mug's shadow.
WINDOW_ANGULAR_RADIUS_DEG = 7.0
AMBIENT_RATIO = 0.2  # ambient radiance relative to the window's irradiance
BOARD_YAML = (
    "type: single\n"
    f"marker_length_m: {MARKER_LENGTH_M}\nseparation_m: {MARGIN_M}\nfirst_id: 0\n"
    "dictionary: {marker_size: 6, border_bits: 3, image: marker.png}\n"
)


def read_camera(path: Path, width: int, height: int) -> CameraModel:
    """Returns the intrinsics of the authors' OpenCV XML file."""
    root = ElementTree.parse(path).getroot()
    values = {
        name: np.array((root.findtext(f"{name}/data") or "").split(), float)
        for name in ("intrinsic", "distortion")
    }
    return CameraModel(width, height, values["intrinsic"].reshape(3, 3), "plumb_bob", values["distortion"])


def read_light_direction(path: Path) -> Float64[np.ndarray, "3"]:
    """Returns the direction of travel in the optical frame.

    The file's camera space is left-handed, y up, z forward.
    """
    root = ElementTree.parse(path).getroot() if path.read_text().count("<camera>") == 0 else _settings(path)
    x, y, z = (float(root.findtext(f"light/direction/{axis}") or 0) for axis in "xyz")
    direction = np.array([x, -y, z])
    return np.asarray(direction / np.linalg.norm(direction))


def _settings(path: Path) -> ElementTree.Element:
    """Parses the settings file, which has several roots, by wrapping them in one."""
    text = path.read_text().split("?>", 1)[-1]
    return ElementTree.fromstring(f"<settings>{text}</settings>")


def scene_document(direction: Float64[np.ndarray, "3"], asset: Path) -> dict[str, Any]:
    """Returns table from a model, Buddha on the marker, window and ambient light, registered by its paper."""
    mesh = trimesh.load(asset, force="mesh", process=False)
    low, high = mesh.bounds[:, 1]
    scale = BUDDHA_HEIGHT_M / float(high - low)
    place = [MARKER_LENGTH_M / 2, -MARKER_LENGTH_M / 2, -scale * float(low)]
    return {
        "name": "the papers' scene",
        "real": {"geometry": {"model": "table.ply"}},
        "objects": [
            {
                "id": "buddha",
                "asset": str(asset.resolve()),
                "up_axis": "y",
                "pose": {"translation_m": place, "rotation_wxyz": [0, 0, 0, 1], "scale": scale},
            }
        ],
        "lights": {
            "mode": "manual",
            "registration": "auto",
            "manual": [
                {
                    "type": "directional",
                    "direction": [float(v) for v in direction],
                    "irradiance": 1.0,
                    "angular_radius_deg": WINDOW_ANGULAR_RADIUS_DEG,
                },
                {"type": "ambient", "radiance": AMBIENT_RATIO},
            ],
        },
        "method": {"name": "dvct"},
    }


def write_scene(source: Path, out: Path) -> None:
    """Writes dataset folder, table model and scene document into `out`.

    Raises:
        DeltalightError: a file of the authors' data is missing, or the marker is not found.
    """
    photograph, buddha = source / "real_static_scene.png", source / "tracked" / "happy.obj"
    for needed in (
        photograph,
        buddha,
        source / "marker.png",
        source / "camera_parameters.xml",
        source / "demo_gi_mr.xml",
    ):
        if not needed.is_file():
            raise DeltalightError(f"{needed} is missing: give the `data` folder of the Dirtchamber release.")
    picture = decode_rgb(photograph.read_bytes(), str(photograph))
    camera = read_camera(source / "camera_parameters.xml", picture.shape[1], picture.shape[0])
    board = _board(source / "marker.png", out)
    with DatasetWriter(out / "dataset", board=board) as writer:
        writer.add(SensorFrame(0, 0, picture, camera))
    pose = BoardDetector(board, camera).detect(picture)
    if pose is None:
        raise DeltalightError(f"the marker was not found in {photograph}.")
    place = trimesh.transformations.translation_matrix((*TABLE_CENTRE_M, -0.01))
    trimesh.creation.box((*TABLE_M, 0.02), place).export(out / "table.ply")
    direction = pose.world_from_camera[:3, :3] @ read_light_direction(source / "demo_gi_mr.xml")
    (out / "scene.json").write_text(json.dumps(scene_document(direction, buddha), indent=2) + "\n")


def _board(marker: Path, out: Path) -> BoardSpec:
    """Returns the one-marker board; its code is read from the authors' picture."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "marker.png").write_bytes(marker.read_bytes())
    (out / "board.yaml").write_text(BOARD_YAML)
    return load_board_yaml(out / "board.yaml")


def main(
    source: Annotated[Path, typer.Argument(help="The `data` folder of the Dirtchamber release.")],
    out: Annotated[Path, typer.Argument(help="Folder to make.")],
) -> None:
    """Makes the papers' scene ready for `deltalight render`."""
    try:
        write_scene(source, out)
    except DeltalightError as error:
        sys.stderr.write(f"{error}\n")
        raise typer.Exit(2) from None
    sys.stdout.write(
        f"now run: deltalight render {out}/dataset --scene {out}/scene.json --out {out}/pictures\n"
    )


if __name__ == "__main__":
    typer.run(main)
