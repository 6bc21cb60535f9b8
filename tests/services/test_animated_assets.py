"""Uploads that play: the clips are told, and one that does not hold together is refused by name."""

import json
from pathlib import Path

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


def test_a_clip_that_does_not_hold_together_is_refused_in_the_limited_child(tmp_path: Path) -> None:
    data = (ASSETS / "figure.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    document["animations"][1]["channels"][0]["sampler"] = 99
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    (tmp_path / "blob").with_suffix(".glb").write_bytes(
        data[:8] + size + len(text).to_bytes(4, "little") + data[16:20] + text + rest
    )
    with pytest.raises(
        RejectedAssetError, match=r"walker\.glb: in its animation `walk`, channel 0 names a sampler"
    ):
        probe(tmp_path / "blob.glb", "mesh", "walker.glb")
