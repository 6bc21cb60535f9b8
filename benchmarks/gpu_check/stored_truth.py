"""A scene with its path-traced truth that goes with the package, so that machines without Mitsuba measure quality.

`python -m deltalight.benchmarks.make_stored_truth` makes the file.
"""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.pictures import decode_rgb, read_bytes
from deltalight.protocol.scene import load_scene
from deltalight.protocol.source import open_source

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext

FILE = Path(__file__).with_name("stored_truth.zip")
SCENE_FILE, REFERENCE_FILE, CHANGED_FILE, ABOUT_FILE = (
    "scene.json",
    "reference.png",
    "changed.png",
    "about.json",
)
VOLUME = 64  # voxels an edge, on every machine

Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class StoredTruth:
    """A dataset folder (docs/formats.md 1) of one frame, its scene, and the camera's picture with the objects."""

    folder: Path

    @classmethod
    def unpacked(cls, folder: Path, file: Path = FILE) -> "StoredTruth":
        """Unpacks the file into a folder."""
        with ZipFile(file) as packed:
            packed.extractall(folder)
        return cls(folder)

    @cached_property
    def about(self) -> dict[str, Any]:
        """What it was made of; `psnr_db` of each method in software when it was made."""
        found: dict[str, Any] = json.loads((self.folder / ABOUT_FILE).read_text())
        return found

    @cached_property
    def view(self) -> ViewFrame:
        """The frame without the objects, cleaned as a node does it."""
        from deltalight.sensor_node.view_frames import ViewFrameBuilder

        source = open_source(self.folder)
        return ViewFrameBuilder(source)(source[0])

    @cached_property
    def changed(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that the objects change, by the noise-free truth."""
        return self._picture(CHANGED_FILE)[..., 0] > 0

    def _picture(self, name: str) -> Picture:
        path = self.folder / name
        return decode_rgb(read_bytes(path), str(path))

    def psnr_db(self, gpu: "GpuContext", method: str) -> float:
        """Returns the PSNR on what the objects change of a method's picture.

        Raises:
            DeltalightError: the method cannot be used here.
        """
        from deltalight.benchmarks.variants import parse_variants
        from deltalight.render_server.renderer import SceneRenderer

        (variant,) = parse_variants(method)
        renderer = SceneRenderer(gpu, variant.applied(load_scene(self.folder / SCENE_FILE), VOLUME))
        try:
            picture = renderer.render(self.view).color
        finally:
            renderer.release()
        return self.psnr_of(picture)

    def psnr_of(self, picture: Picture) -> float:
        """Returns the PSNR of a picture on what the objects change; infinite for truth itself."""
        error: Float64[np.ndarray, "n 3"] = (picture.astype(float) - self._picture(REFERENCE_FILE))[
            self.changed
        ]
        return float(10 * np.log10(255**2 / max(float(np.mean(error**2)), 1e-12)))
