"""Values that several commands take."""

from enum import StrEnum


class View(StrEnum):
    """What a picture shows (`output.view` of the scene document)."""

    COMPOSITE = "composite"
    EFFECTS = "effects"
    DELTA = "delta"
    VOLUME = "volume"
    RSM = "rsm"
    LIGHTS = "lights"


class Method(StrEnum):
    """A relighting method that is built: dvct as the scene says, or with one of its operators."""

    DVCT = "dvct"
    EXACT = "exact"
    PAPER = "paper"
