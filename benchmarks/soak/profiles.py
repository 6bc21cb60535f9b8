"""How large a station is soaked, and for how long each fault lasts."""

from dataclasses import dataclass, replace
from typing import Any

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError


@dataclass(frozen=True)
class Profile:
    """A station and its faults.

    `nodes` sensor nodes send pictures of `size` (pixels) `frames_per_s` times a second: of a recording in which
    nothing moves or, if `is_synthetic`, of the synthetic camera, which sways, so that pixels before and after a kill
    differ. `output` and `method` change the demo's scene. `calm_s` is the time before, between and after faults,
    `load_s` that of faults that go on for a while, `stop_s` that of stopped processes, `spare_s` how long at most a
    fault waits until the spares of killed processes are ready, `viewers` the number that joins and leaves, for
    `churn_s`.
    """

    nodes: int
    size: tuple[int, int]
    frames_per_s: float
    output: dict[str, Any]
    method: dict[str, Any]
    calm_s: float
    load_s: float
    stop_s: float
    spare_s: float
    viewers: int
    churn_s: float
    is_synthetic: bool = False

    @property
    def period_ms(self) -> float:
        """Time from one picture of a node to its next."""
        return 1e3 / self.frames_per_s


_FEW_CONES: dict[str, Any] = {
    "volume_size": 32,
    "cone_count": 4,
    "cone_scale": 4,
    "bounces": 0,
    "rsm_size": 256,
}
_PLAIN: dict[str, Any] = {"caustics": False, "screen_space": False, "far_volume": False, "shadow_samples": 1}

_DESK = Profile(
    nodes=1,
    size=(320, 240),
    frames_per_s=10.0,
    output={"width": 160, "height": 120},
    method={**_FEW_CONES, **_PLAIN},
    calm_s=6.0,
    load_s=15.0,
    stop_s=10.0,
    spare_s=180.0,
    viewers=50,
    churn_s=60.0,
)
PROFILES = {
    "station": replace(
        _DESK,
        nodes=4,
        frames_per_s=15.0,
        output={"width": 320, "height": 240},
        method={"quality": "live"},
        calm_s=8.0,
        load_s=20.0,
    ),
    "desk": _DESK,
    "synthetic": replace(_DESK, is_synthetic=True),
    "small": replace(
        _DESK,
        frames_per_s=5.0,
        output={"width": 96, "height": 72},
        calm_s=1.0,
        load_s=3.0,
        stop_s=2.0,
        spare_s=0.0,
        viewers=10,
        churn_s=3.0,
    ),
}


def choose_profile(name: str) -> Profile:
    """Returns a profile by its name.

    Raises:
        DeltalightError: there is none of that name.
    """
    if name not in PROFILES:
        hint = nearest(name, PROFILES) or ", ".join(PROFILES)
        raise DeltalightError(f"There is no profile '{name}'; did you mean {hint}?")
    return PROFILES[name]
