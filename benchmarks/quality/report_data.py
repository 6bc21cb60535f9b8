"""The benchmark's figures as plain data: quality.json."""

import math
import os
from dataclasses import asdict
from typing import Any

from deltalight.benchmarks.quality import REPORT_KIND
from deltalight.benchmarks.quality.evaluate import QualityResult, SceneResult
from deltalight.benchmarks.quality.figures import Figures
from deltalight.benchmarks.quality.tables import COLUMNS


def as_data(result: QualityResult) -> dict[str, Any]:
    """Returns everything but the pictures, as JSON: null for figures that are undefined or infinite."""
    job = result.job
    return {
        "kind": REPORT_KIND,
        "version": 1,
        "renderer": result.renderer,
        "cpus": os.cpu_count(),
        "size": list(job.size),
        "spp": job.spp,
        "volume_size": job.volume_size,
        "columns": [asdict(column) for column in COLUMNS],
        "variants": {
            variant.name: {"sentence": variant.sentence, "settings": dict(variant.settings)}
            for variant in result.variants
        },
        "means": {name: _finite(figures) for name, figures in result.means().items()},
        "scenes": {scene.scene.name: _scene_data(scene) for scene in result.scenes},
    }


def _scene_data(scene: SceneResult) -> dict[str, Any]:
    return {
        "title": scene.scene.title,
        "frames": scene.scene.frame_count,
        "halves_psnr_db": scene.halves_psnr_db,
        "variants": {
            name: {
                "is_repeatable": variant.is_repeatable,
                "history_codes": variant.history_codes,
                "note": variant.note,
                "figures": _finite(variant.figures),
            }
            for name, variant in scene.variants.items()
        },
    }


def _finite(figures: Figures) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}
