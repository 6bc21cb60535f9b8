"""Names and settings of `--methods`: the renderer with chosen settings, and what `bench quality` compares it with."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from deltalight.benchmarks.raster import RasterMethod, register_raster
from deltalight.protocol.documents import StrictModel, nearest, parse_mapping, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.methods import PLUGINS, SETTINGS
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import MethodSettings, NoneMethod
from deltalight.protocol.scene_output import Output, Shading

RASTER = RasterMethod.method_name()
MODELS: dict[str, type[MethodSettings]] = {**SETTINGS, RASTER: RasterMethod}
"""Kinds that the renderer makes, by the names of their methods."""
SIZED_BY_CELLS = ("dlpv", "aroof")
"""Kinds whose `volume_size` is not in voxels."""
ADJUSTABLE: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in PLUGINS.values},
    "dvct": ("dvct", {}),
    "exact": ("dvct", {"operator": "exact"}),
    "paper": ("dvct", {"operator": "paper"}),
    "differential": ("differential", {}),
    "dlpv": ("dlpv", {"operator": "difference"}),
    "dlpv-paper": ("dlpv", {"operator": "paper"}),
    "aroof": ("aroof", {}),
    RASTER: (RASTER, {}),
}
"""Variants that take settings: their kind and what they set themselves. Installed plugins are among them."""
OTHER_PARTS: dict[str, type[StrictModel]] = {"output": Output, "shading": Shading}
"""Parts of the scene document besides `method` whose settings a variant may name."""
TIMED_VARIANT = "exact"
"""The kinds of path tracing take the time of this one's frame."""


@dataclass(frozen=True)
class Variant:
    """One way to make the picture; `settings` are changes of the scene document (kinds in MODELS).

    A key names a setting of `method`, or one of `lights`, `output` or `shading` with that before a dot.
    """

    name: str
    sentence: str
    kind: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_traced(self) -> bool:
        """Whether a path tracer makes it, in the time of TIMED_VARIANT's frame."""
        return self.kind in ("path", "denoised path")

    @property
    def runs_in_processes(self) -> bool:
        """Whether other processes know its method too."""
        return self.kind in SETTINGS

    def applied(self, document: SceneDocument, volume_size: int | None) -> SceneDocument:
        """Returns the document with this variant's method; `volume_size` applies if no setting names one."""
        if self.kind == "none":
            return document.replaced(method=NoneMethod())
        if (
            self.kind == RASTER
        ):  # a method that `SceneDocument.replaced` does not know, and that finds no light
            register_raster()
            document = document.replaced(lights=document.lights.replaced(surroundings="none"))
        model = MODELS.get(self.kind)
        if model is not None and not isinstance(document.method, model):
            document = document.model_copy(update={"method": model()})
        parts: dict[str, dict[str, Any]] = {"method": {}, "lights": {}, "output": {}, "shading": {}}
        if volume_size is not None and self._has_voxels(document.method):
            parts["method"]["volume_size"] = volume_size
        for key, value in self.settings.items():
            part, _, name = key.rpartition(".")
            parts[part or "method"][name] = value
        changed = {part: getattr(document, part).replaced(**changes) for part, changes in parts.items()}
        return document.model_copy(update=changed)

    def _has_voxels(self, method: MethodSettings) -> bool:
        return self.kind not in SIZED_BY_CELLS and "volume_size" in type(method).model_fields


FIXED: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        *(Variant(name, f"of package {one.plugin.package}", name) for name, one in PLUGINS.values.items()),
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
        Variant(
            RASTER,
            "objects rasterised over the picture: no shadows, no light of the room; a floor of cost",
            RASTER,
        ),
        Variant("path", "path tracing with and without objects, in the time of an `exact` frame", "path"),
        Variant(
            "path+oidn",
            "the same with fewer light paths and both pictures denoised (Intel Open Image Denoise)",
            "denoised path",
        ),
    )
}
RENDERED = tuple(
    name
    for name, variant in FIXED.items()
    if variant.kind in MODELS and "lights.mode" not in variant.settings
)
"""Variants that `bench speed` times: all that the renderer makes with the scene's own lights."""


def parse_variants(text: str, known: Collection[str] = FIXED) -> list[Variant]:
    """Parses `camera,paper,exact:cone_count=32,output.antialiasing=true`: names among `known`, separated by commas.

    Settings are the method's, or the document's `output` or `shading`.

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
    traced = next((one for one in variants if one.is_traced), None)
    if traced is not None and TIMED_VARIANT not in written[: written.index(traced.name)]:
        raise DeltalightError(
            f"`{traced.name}` takes the time of `{TIMED_VARIANT}`; add {TIMED_VARIANT} to --methods before it."
        )
    return variants


def _parse(text: str, known: Collection[str]) -> Variant:
    name, _, changes = text.partition(":")
    fault = PLUGINS.fault(name)
    if fault is not None and name not in known:
        raise DeltalightError(fault)
    if not changes and name in known:
        return FIXED[name]
    if not changes or name not in ADJUSTABLE:
        close, adjustable = nearest(name, known), " or ".join(f"{one}:KEY=VALUE" for one in ADJUSTABLE)
        hint = "" if close is None or changes else f"; the nearest is {close}"
        raise DeltalightError(
            f"'{text}' is not a method to compare{hint}; use {', '.join(known)}, or {adjustable}."
        )
    kind, own = ADJUSTABLE[name]
    settings = dict(own)
    for pair in changes.split(","):
        settings |= _setting(pair, text)
    where = f"--methods {text}"
    validate(MODELS[kind], {key: value for key, value in settings.items() if "." not in key}, where)
    for part, model in OTHER_PARTS.items():
        own_keys = {key.partition(".")[2]: value for key, value in settings.items() if _part(key) == part}
        validate(model, own_keys, where)
    others = [key for key in settings if _part(key) not in ("method", *OTHER_PARTS)]
    if others:
        raise DeltalightError(
            f"`{others[0]}` in '{text}' is not a setting; write one of the method, output.KEY or shading.KEY."
        )
    return Variant(text, f"{name} with {changes.replace(',', ', ')}", kind, settings)


def _part(key: str) -> str:
    """The part of the scene document that a setting belongs to."""
    part, dot, _ = key.partition(".")
    return part if dot else "method"


def _setting(pair: str, variant: str) -> dict[str, Any]:
    key, equals, value = pair.partition("=")
    if not equals:
        raise DeltalightError(f"'{pair}' in '{variant}' is not a setting; write KEY=VALUE.")
    return parse_mapping(f"{key.strip()}: {value}", f"--methods {variant}", is_json=False)
