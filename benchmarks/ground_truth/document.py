"""The scene document of a benchmark scene (docs/formats.md 3)."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from deltalight.benchmarks.ground_truth.assembly import ENVIRONMENT_FILE
from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene, VirtualObject
from deltalight.protocol.poses import wxyz_from_rotation

DOCUMENT_FILE = "scene.json"
FRAMES_FOLDER = "scenes"


def scene_document(scene: BenchmarkScene, frame: int, assets: str = "") -> dict[str, Any]:
    """Returns the document of one frame; the names of its assets begin with `assets`."""
    return {
        "name": scene.title,
        "real": {"geometry": "depth", "surfaces": list(scene.surfaces)},
        "objects": [_object(item, frame, assets) for item in scene.objects],
        "lights": _lights(scene, assets),
        "method": {"name": "dvct", **scene.settings},
        "output": {"antialiasing": True},
    }


def _object(item: VirtualObject, frame: int, assets: str) -> dict[str, Any]:
    pose, finish = item.world_from_object[frame], item.finish
    return {
        "id": item.id,
        "asset": f"{assets}{item.id}.ply",
        "pose": {
            "translation_m": [float(v) for v in pose[:3, 3]],
            "rotation_wxyz": [float(v) for v in wxyz_from_rotation(pose[:3, :3])],
        },
        "material": {
            "base_color": list(finish.base_color),
            "roughness": finish.roughness,
            "metallic": finish.metallic,
            "specular": finish.specular,
            "emission": list(finish.emission),
            **({"transmission": finish.transmission} if finish.transmission else {}),
        },
    }


def _lights(scene: BenchmarkScene, assets: str) -> dict[str, Any]:
    """Returns the lights, whose strength is known, so that none is registered."""
    registration = [1.0, 1.0, 1.0]
    if scene.environment is not None:
        map_file = {"map": assets + ENVIRONMENT_FILE}
        return {"mode": "environment", "environment": map_file, "registration": registration}
    lamps = [lamp.document() for lamp in scene.lamps]
    return {"mode": "manual", "manual": lamps, "registration": registration}


def objects_move(scene: BenchmarkScene) -> bool:
    """Whether any object is elsewhere in a later frame."""
    return any(
        not np.array_equal(pose, item.world_from_object[0])
        for item in scene.objects
        for pose in item.world_from_object
    )


def document_path(folder: Path, scene: BenchmarkScene, frame: int) -> Path:
    """Returns the path of a frame's document; scenes at rest have one for all frames."""
    return folder / FRAMES_FOLDER / f"{frame:06d}.json" if objects_move(scene) else folder / DOCUMENT_FILE


def write_documents(folder: Path, scene: BenchmarkScene) -> None:
    """Writes the first frame's document and, if objects move, one for each frame."""
    _write(folder / DOCUMENT_FILE, scene_document(scene, 0))
    if objects_move(scene):
        (folder / FRAMES_FOLDER).mkdir()
        for frame in range(scene.frame_count):
            _write(document_path(folder, scene, frame), scene_document(scene, frame, assets="../"))


def _write(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
