"""Make the truth that `deltalight gpu-check` compares with: `python -m deltalight.benchmarks.make_stored_truth`.

It packs a scene of `bench quality` at its usual size (needs Mitsuba; minutes where its truth is not cached), and
measures every method beside it in software.
"""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from rich.progress import Progress

from deltalight.benchmarks.gpu_check.steps import RATED
from deltalight.benchmarks.gpu_check.stored_truth import (
    ABOUT_FILE,
    CHANGED_FILE,
    FILE,
    REFERENCE_FILE,
    StoredTruth,
)
from deltalight.benchmarks.ground_truth.scenes import scene_named
from deltalight.benchmarks.ground_truth.truth import Truth, ensure_truth
from deltalight.benchmarks.quality.regions import find_regions
from deltalight.protocol.pictures import encode_png
from deltalight.render_server.gpu.context import create_context

SCENE, SIZE, SPP = "two_lights", (320, 240), 512
LEFT_OUT = ("fisheye", "truth")


def pack(truth: Truth, file: Path, psnr_db: Mapping[str, float]) -> None:
    """Writes the frame, its scene and what it is compared with into a file, the same bytes each time."""
    frame = truth.frame(0)
    regions = find_regions(frame.without, frame.with_objects, frame.cover)
    parts = {
        str(path.relative_to(truth.folder)): path.read_bytes()
        for path in sorted(truth.folder.rglob("*"))
        if path.is_file() and not str(path.relative_to(truth.folder)).startswith(LEFT_OUT)
    }
    parts[REFERENCE_FILE] = encode_png(frame.sensor_with)
    parts[CHANGED_FILE] = encode_png(np.repeat(255 * regions.changed[..., None].astype(np.uint8), 3, axis=2))
    about = {"scene": truth.scene.name, "spp": truth.spp, "psnr_db": dict(psnr_db)}
    parts[ABOUT_FILE] = json.dumps(about, indent=2).encode()
    with ZipFile(file, "w") as packed:
        for name, content in parts.items():
            packed.writestr(ZipInfo(name), content, ZIP_DEFLATED, 9)


def main() -> None:
    """Writes the file twice: to measure by it, and with what was measured."""
    with Progress() as progress:
        truth = ensure_truth(scene_named(SCENE), size=SIZE, spp=SPP, progress=progress)
    pack(truth, FILE, {})
    gpu = create_context()
    with tempfile.TemporaryDirectory() as folder:
        stored = StoredTruth.unpacked(Path(folder))
        found = {method: round(stored.psnr_db(gpu, method), 2) for method in RATED}
    gpu.release()
    pack(truth, FILE, found)
    print(f"{FILE}: {FILE.stat().st_size} bytes, {found}")


if __name__ == "__main__":
    main()
