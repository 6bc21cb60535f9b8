"""Names and settings of `--methods`: the renderer with chosen settings, and what `bench quality` compares it with."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from protocol.documents import nearest, parse_mapping, validate
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
    "dvct": ("dvct", {}),
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
        Variant("dvct", "voxel cone tracing as the scene says", "dvct"),
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


def parse_variants(text: str, known: Collection[str] = FIXED) -> list[Variant]:
    """Parse `camera,paper,exact:cone_count=32,cone_scale=1`: names among `known` with settings, separated by commas.

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
    variants = [_parse(one, known) for one in written]
    if "path" in written and TIMED_VARIANT not in written:
        raise DeltalightError(
            f"`path` takes the time of `{TIMED_VARIANT}`; add {TIMED_VARIANT} to --methods."
        )
    return variants


def _parse(text: str, known: Collection[str]) -> Variant:
    name, _, changes = text.partition(":")
    if not changes and name in known:
        return FIXED[name]
    if not changes or name not in ADJUSTABLE:
        close, adjustable = nearest(name, known), " or ".join(f"{one}:KEY=VALUE" for one in ADJUSTABLE)
        hint = "" if close is None or changes else f"; the nearest is {close}"
        raise DeltalightError(
            f"'{text}' is no method to compare{hint}; use {', '.join(known)}, or {adjustable}."
        )
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
