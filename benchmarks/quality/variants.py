"""What is compared: pictures without relighting, the renderer with chosen settings, path tracing in equal time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from protocol.documents import parse_mapping, validate
from protocol.errors import DeltalightError
from protocol.scene import SceneDocument
from protocol.scene_method import AroofMethod, DifferentialMethod, DlpvMethod, DvctMethod, NoneMethod

Kind = Literal["camera", "none", "dvct", "dlpv", "aroof", "differential", "path"]
METHODS: dict[str, type[DvctMethod | DlpvMethod | AroofMethod | DifferentialMethod]] = {
    "dvct": DvctMethod,
    "dlpv": DlpvMethod,
    "aroof": AroofMethod,
    "differential": DifferentialMethod,
}
"""Kinds that the renderer makes with settings."""
ADJUSTABLE: dict[str, tuple[Kind, dict[str, Any]]] = {
    "exact": ("dvct", {"operator": "exact"}),
    "paper": ("dvct", {"operator": "paper"}),
    "differential": ("differential", {}),
    "dlpv": ("dlpv", {"operator": "difference"}),
    "dlpv-paper": ("dlpv", {"operator": "paper"}),
    "aroof": ("aroof", {}),
}
"""Variants that take settings: their kind and what they set themselves."""
TIMED_VARIANT = "exact"
"""`path` takes the time of this one's frame."""


@dataclass(frozen=True)
class Variant:
    """One way to make the picture; `settings` are changes of the scene document (kinds in METHODS).

    A key names a setting of `method`, or one of `lights` or `output` with that before a dot.
    """

    name: str
    sentence: str
    kind: Kind
    settings: Mapping[str, Any] = field(default_factory=dict)

    def applied(self, document: SceneDocument, volume_size: int | None) -> SceneDocument:
        """Return the document with this variant's method; `volume_size` applies if no setting names one."""
        if self.kind == "none":
            return document.replaced(method=NoneMethod())
        if self.kind in METHODS and not isinstance(document.method, METHODS[self.kind]):
            document = document.replaced(method=METHODS[self.kind]())
        size = {} if volume_size is None or self.kind in ("dlpv", "aroof") else {"volume_size": volume_size}
        parts: dict[str, dict[str, Any]] = {"method": size, "lights": {}, "output": {}}
        for key, value in self.settings.items():
            part, _, name = key.rpartition(".")
            parts[part or "method"][name] = value
        changed = {part: getattr(document, part).replaced(**changes) for part, changes in parts.items()}
        return document.replaced(**changed)


FIXED: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant("camera", "the camera's picture: no object, no relighting", "camera"),
        Variant("none", "objects drawn, the real scene left as it was", "none"),
        Variant("paper", "the operator as printed in [P1]", "dvct", {"operator": "paper"}),
        Variant("exact", "the exact operator, machine's defaults", "dvct", {"operator": "exact"}),
        Variant(
            "fisheye",
            "`exact`, its lights found in the fish-eye picture and scaled by the board's paper",
            "dvct",
            {"operator": "exact", "lights.mode": "fisheye", "lights.registration": "auto"},
        ),
        Variant("aroof", "object occlusion fields, machine's defaults", "aroof"),
        Variant("differential", "two full solutions, subtracted, machine's defaults", "differential"),
        Variant("dlpv", "light propagation volumes, machine's defaults", "dlpv", {"operator": "difference"}),
        Variant("dlpv-paper", "the volume as printed in [P2]", "dlpv", {"operator": "paper"}),
        Variant("path", "path tracing with and without objects, in the time of an `exact` frame", "path"),
    )
}

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
    """Return the chain from the paper's operator to the exact one and beyond, one switch per row."""
    chain: list[Variant] = []
    settings: dict[str, Any] = {}
    for name, sentence, changes in ABLATION_STEPS:
        settings = settings | changes
        chain.append(Variant(name, sentence, "dvct", settings))
    return chain


def parse_variants(text: str) -> list[Variant]:
    """Parse `camera,paper,exact:cone_count=32,cone_scale=1`: names with settings, separated by commas.

    Raises:
        DeltalightError: an unknown name, or a setting that the method does not have or allow.
    """
    written: list[str] = []
    for piece in (piece.strip() for piece in text.split(",")):
        if "=" in piece and ":" not in piece and written:
            written[-1] += f",{piece}"  # a further setting of the previous variant
        else:
            written.append(piece)
    if len(set(written)) < len(written):
        raise DeltalightError(f"--methods '{text}' names one thing twice; write each once.")
    variants = [_parse(one) for one in written]
    if "path" in written and TIMED_VARIANT not in written:
        raise DeltalightError(
            f"`path` takes the time of `{TIMED_VARIANT}`; add {TIMED_VARIANT} to --methods."
        )
    return variants


def _parse(text: str) -> Variant:
    name, _, changes = text.partition(":")
    if not changes and name in FIXED:
        return FIXED[name]
    if not changes or name not in ADJUSTABLE:
        known, adjustable = ", ".join(FIXED), " or ".join(f"{one}:KEY=VALUE" for one in ADJUSTABLE)
        raise DeltalightError(f"'{text}' is no method to compare; use {known}, or {adjustable}.")
    kind, own = ADJUSTABLE[name]
    settings = dict(own)
    for pair in changes.split(","):
        settings |= _setting(pair, text)
    validate(METHODS[kind], settings, f"--methods {text}")
    return Variant(text, f"{name} with {changes.replace(',', ', ')}", kind, settings)


def _setting(pair: str, variant: str) -> dict[str, Any]:
    key, equals, value = pair.partition("=")
    if not equals:
        raise DeltalightError(f"'{pair}' in '{variant}' is no setting; write KEY=VALUE.")
    return parse_mapping(f"{key.strip()}: {value}", f"--methods {variant}", is_json=False)
