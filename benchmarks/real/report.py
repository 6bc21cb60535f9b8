"""The report of `bench real`: real.json, real.md, and pictures side by side."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from deltalight.benchmarks.quality.tables import MISSING, Table
from deltalight.benchmarks.real.bins import BinResult, row_of_pictures
from deltalight.benchmarks.real.cartons import CartonResult, Shown
from deltalight.benchmarks.real.light_fit import FoundLight
from deltalight.benchmarks.real.score import Figures, means
from deltalight.protocol.files import write_bytes, write_png

MEAN = "mean of the others"


def tables(cartons: CartonResult, bins: list[BinResult]) -> list[Table]:
    """Returns the figures as tables: lights, cartons, bins."""
    fitted, *others = cartons.figures
    rows = [
        [f"{name}{' (fitted)' if name == fitted else ''}", way, *_cells(figures)]
        for name, ways in cartons.figures.items()
        for way, figures in ways.items()
    ]
    rows += [[MEAN, way, *_cells(figures)] for way, figures in _means(cartons, others).items()]
    headings = ["Photograph", "way", "table dB", "changed dB", "taken", "added"]
    return [
        Table(
            "Lights of the table",
            ["Light", "azimuth", "elevation", "radius", "R", "G", "B"],
            _light_rows(cartons),
        ),
        Table("Cartons on a table", headings, rows),
        Table("Cartons as they were fitted", ["Photograph", "edges, mm", "outline"], _cuboid_rows(cartons)),
        Table("Things in a bin", ["Camera", "kept", "covered", "none dB", "exact dB"], _bin_rows(bins)),
    ]


def _means(cartons: CartonResult, others: list[str]) -> dict[str, Figures]:
    ways = next(iter(cartons.figures.values()))
    return {way: means([cartons.figures[name][way] for name in others]) for way in ways}


def _cells(figures: Figures) -> list[str]:
    values = (figures.table_psnr_db, figures.changed_psnr_db, figures.taken, figures.added)
    return [
        MISSING if math.isnan(value) else f"{value:.{digits}f}"
        for value, digits in zip(values, (1, 1, 2, 2), strict=True)
    ]


def _light_rows(cartons: CartonResult) -> list[list[str]]:
    discs = [
        [
            str(number),
            *(f"{value:.0f}" for value in _angles_deg(light)),
            *(f"{fraction:.2f}" for fraction in light.fraction),
        ]
        for number, light in enumerate(cartons.lights.lights, 1)
    ]
    return [*discs, ["even", *3 * [MISSING], *(f"{fraction:.2f}" for fraction in cartons.lights.even)]]


def _angles_deg(light: FoundLight) -> tuple[float, float, float]:
    x, y, z = light.towards
    azimuth, elevation, radius = np.degrees([np.arctan2(y, x), np.arcsin(z), light.radius])
    return float(azimuth), float(elevation), float(radius)


def _cuboid_rows(cartons: CartonResult) -> list[list[str]]:
    return [
        [
            name,
            " x ".join(f"{1000 * edge:.0f}" for edge in sorted(cuboid.size_m)),
            f"{cartons.agreement[name]:.1%}",
        ]
        for name, cuboid in cartons.cuboids.items()
    ]


def _bin_rows(bins: list[BinResult]) -> list[list[str]]:
    return [
        [
            str(each.camera),
            f"{each.kept:.1%}",
            f"{each.covered:.1%}",
            f"{each.none_psnr_db:.1f}",
            f"{each.exact_psnr_db:.1f}",
        ]
        for each in bins
    ]


def as_data(cartons: CartonResult, bins: list[BinResult]) -> dict[str, Any]:
    """Returns everything but the pictures, as JSON: null for what is undefined."""
    lights = [
        {
            **dict(zip(("azimuth_deg", "elevation_deg", "radius_deg"), _angles_deg(each), strict=True)),
            "share": each.fraction.tolist(),
        }
        for each in cartons.lights.lights
    ]
    fitted, *others = cartons.figures
    figures = {
        name: {way: _finite(each) for way, each in ways.items()} for name, ways in cartons.figures.items()
    }
    return {
        "kind": "deltalight real photographs",
        "version": 1,
        "cartons": {
            "plane_rms_mm": 1000 * cartons.plane.rms_m,
            "fitted": fitted,
            "lights": lights,
            "even": cartons.lights.even.tolist(),
            "cuboids": {name: asdict(cuboid) for name, cuboid in cartons.cuboids.items()},
            "outlines": cartons.agreement,
            "photographs": figures,
            "means": {way: _finite(each) for way, each in _means(cartons, others).items()},
        },
        "bins": [
            {
                "camera": each.camera,
                "kept": each.kept,
                "covered": each.covered,
                "none_psnr_db": each.none_psnr_db,
                "exact_psnr_db": each.exact_psnr_db,
            }
            for each in bins
        ],
    }


def _finite(figures: Figures) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in asdict(figures).items()}


def write_report(folder: Path, cartons: CartonResult, bins: list[BinResult]) -> None:
    """Writes real.json, real.md and the pictures into a folder that exists."""
    write_bytes(folder / "real.json", (json.dumps(as_data(cartons, bins), indent=2) + "\n").encode())
    text = "\n".join(["# Real photographs", "", *(table.markdown() for table in tables(cartons, bins))])
    write_bytes(folder / "real.md", text.encode())
    for shown in cartons.shown:
        write_png(folder / f"{shown.name}.png", _side_by_side(shown))
    write_png(folder / "bins.png", row_of_pictures(bins))


def _side_by_side(shown: Shown) -> np.ndarray:
    """Returns fit and photograph over the relit table and the one with a blob."""
    return np.vstack(
        [np.hstack([shown.fit, shown.truth]), np.hstack([shown.results["exact"], shown.results["blob"]])]
    )
