"""Qualities of a moving picture: what each gives up for speed (docs/speed.md, quality and speed)."""

from dataclasses import dataclass
from typing import Literal, get_args

from deltalight.protocol.errors import DeltalightError

Quality = Literal["live", "balanced", "best"]


def require_quality(name: Quality) -> Quality:
    """Returns the name if there is such a quality.

    Raises:
        DeltalightError: there is none.
    """
    if name not in get_args(Quality):
        raise DeltalightError(f"'{name}' is not a quality; use one of {', '.join(get_args(Quality))}.")
    return name


@dataclass(frozen=True)
class QualityTier:
    """What a quality gives up while something moves.

    `cone_count` and `shadow_samples` limit the settings of that name; a volume has `volume_scale` of its voxels an
    edge. `reflection_cones` look up what a pixel of a smooth object reflects, in one of `reflection_step` x
    `reflection_step` pixels; while only the camera moves, in one tile of the picture in `reflection_turns`, and
    where nothing that the frame before looked up serves. `caustic_blocks` x `caustic_blocks` blocks of each light's
    map of the objects send beams. While objects move, the light that they throw back, block between surfaces and
    focus is found in one of `bounce_turns` frames; their shadows are in every one. One tile of the picture in
    `refresh_tiles` gets new light in each frame in which only the camera moves, the others keep that of the frame
    before; 0: all get new light, and the real scene is built anew whenever the camera moves. `distant_light`:
    objects also take and add light at surfaces beyond their volumes. `glass_rays`: with transparent objects, rays
    find the penumbrae on real surfaces, and cones bend.
    """

    cone_count: int = 64
    shadow_samples: int = 64
    volume_scale: float = 1.0
    reflection_cones: Literal[2, 4] = 4
    reflection_step: Literal[1, 2] = 1
    reflection_turns: int = 1
    caustic_blocks: Literal[32, 64] = 64
    refresh_tiles: int = 0
    bounce_turns: int = 1
    distant_light: bool = True
    glass_rays: bool = True


BEST = QualityTier()
TIERS: dict[Quality, QualityTier] = {
    "best": BEST,
    "balanced": QualityTier(reflection_turns=4, refresh_tiles=8, distant_light=False, glass_rays=False),
    "live": QualityTier(
        cone_count=8,
        shadow_samples=8,
        volume_scale=0.75,
        reflection_cones=2,
        reflection_step=2,
        reflection_turns=4,
        caustic_blocks=32,
        refresh_tiles=16,
        bounce_turns=3,
        distant_light=False,
        glass_rays=False,
    ),
}
