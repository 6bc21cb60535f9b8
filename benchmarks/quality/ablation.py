"""The chain from the paper's operator to the exact one and beyond, one switch a row."""

from typing import Any

from deltalight.benchmarks.variants import Variant

PAPER_IN_SOFTWARE: dict[str, Any] = {
    "operator": "paper",
    "shadow": "cone",
    "composition": "additive",
    "cone_scale": 4,
    "volume_size": 64,
    "lights.surroundings": "none",
    "output.antialiasing": False,
}
"""Everything that a later row switches, so that a chain means the same on every machine."""
BARE_EXACT: dict[str, Any] = {
    "operator": "exact",
    "cone_count": 9,
    "voxels": "isotropic",
    "coverage": "multiplied",
    "radiance": "predicted",
    "far_volume": False,
    "bounces": 0,
    "reflections": "cones",
    "mirrored_lights": False,
    "caustics": False,
    "screen_space": False,
}
"""Two sets of voxels marched, everything else as far as possible as in the paper."""

ABLATION_STEPS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    # name, sentence, change against the previous row
    (
        "paper",
        "the operator as printed in [P1], 64 voxels an edge, cones at every 4th pixel",
        PAPER_IN_SOFTWARE,
    ),
    ("+ shadow maps", "shadows from maps in place of shadow cones", {"shadow": "map"}),
    ("+ ratio", "the change multiplies the picture in place of being added", {"composition": "ratio"}),
    ("+ two sets", "voxels without and with objects, both marched", BARE_EXACT),
    ("+ one-sided voxels", "six directions a voxel in place of one", {"voxels": "directional"}),
    ("+ summed coverage", "a shell of voxels is a wall", {"coverage": "summed"}),
    ("+ 16 cones", "16 equal cones in place of 9", {"cone_count": 16}),
    ("+ measured radiance", "real surfaces shine as the camera sees them", {"radiance": "measured"}),
    ("+ far volume", "the real scene beyond the volume, coarse", {"far_volume": True}),
    ("+ surroundings", "light of what is out of sight", {"lights.surroundings": "auto"}),
    ("+ bounce", "light gathered once more from voxel to voxel", {"bounces": 1}),
    ("+ rays", "objects in smooth real surfaces by rays", {"reflections": "rays"}),
    ("+ mirrored lights", "smooth declared planes throw the lights back", {"mirrored_lights": True}),
    ("+ caustics", "smooth objects throw the lights on as beams", {"caustics": True}),
    ("+ screen space", "smooth objects reflect the picture", {"screen_space": True}),
    ("+ antialiasing", "coverage of pixels at the objects' edges", {"output.antialiasing": True}),
    ("+ every pixel", "cones traced at every pixel", {"cone_scale": 1}),
    ("+ finer voxels", "128 voxels an edge", {"volume_size": 128}),
)


def ablation_chain() -> list[Variant]:
    """Returns the chain from the paper's operator to the exact one and beyond, one switch per row."""
    chain: list[Variant] = []
    settings: dict[str, Any] = {}
    for name, sentence, changes in ABLATION_STEPS:
        settings = settings | changes
        chain.append(Variant(name, sentence, "dvct", settings))
    return chain
