"""Uploads that play: the clips are told, and one that does not hold together is refused by name."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deltalight.services.storage.asset_sandbox import probe
from deltalight.services.storage.faults import RejectedAssetError

ASSETS = Path(__file__).parents[2] / "services" / "demo_assets"


def test_clips_are_among_the_facts_of_a_mesh() -> None:
    assert probe(ASSETS / "figure.glb", "mesh", "figure.glb")["clips"] == [
        {"name": "round", "duration_s": 3.0},
        {"name": "walk", "duration_s": 1.0},
    ]
    assert probe(ASSETS / "object.glb", "mesh", "object.glb")["clips"] == []


def changed_figure(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Writes the demo's figure with another glTF document."""
    data = (ASSETS / "figure.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    path.write_bytes(data[:8] + size + len(text).to_bytes(4, "little") + data[16:20] + text + rest)
    return path


def test_a_clip_that_does_not_hold_together_is_refused_in_the_limited_child(tmp_path: Path) -> None:
    def break_sampler(document: dict[str, Any]) -> None:
        document["animations"][1]["channels"][0]["sampler"] = 99

    with pytest.raises(
        RejectedAssetError, match=r"walker\.glb: in its animation `walk`, channel 0 names a sampler"
    ):
        probe(changed_figure(tmp_path / "blob.glb", break_sampler), "mesh", "walker.glb")


def test_a_clip_whose_name_postgresql_cannot_keep_is_refused(tmp_path: Path) -> None:
    def rename(document: dict[str, Any]) -> None:
        document["animations"][1]["name"] = "wa\0lk"

    with pytest.raises(RejectedAssetError, match=r"walker\.glb: .* must not hold a NUL character"):
        probe(changed_figure(tmp_path / "blob.glb", rename), "mesh", "walker.glb")
