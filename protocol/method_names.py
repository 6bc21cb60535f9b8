"""Short names of relighting methods, as command lines and `deltalight.Renderer` take them."""

from difflib import get_close_matches
from typing import TYPE_CHECKING

from deltalight.protocol.errors import DeltalightError

if TYPE_CHECKING:
    from deltalight.protocol.scene import SceneDocument

METHODS = ("dvct", "exact", "paper", "dlpv", "dlpv-paper", "aroof", "differential", "none")
"""The project's relighting methods: dvct as the scene says, or one of its operators, or another one's defaults."""


def require_method(name: str) -> str:
    """Returns the name if there is such a method, the project's or an installed plugin's.

    Raises:
        DeltalightError: there is none, or it comes from a plugin that cannot be used.
    """
    from deltalight.protocol.methods import PLUGINS

    known = [*METHODS, *PLUGINS.values]
    if name in known:
        return name
    fault = PLUGINS.fault(name)
    if fault is not None:
        raise DeltalightError(fault)
    nearest = get_close_matches(name, known, 1, cutoff=0)[0]
    raise DeltalightError(f"'{name}' is not a method; the nearest is {nearest}, of {', '.join(known)}.")


def with_method(scene: "SceneDocument", method: str) -> "SceneDocument":
    """Returns the scene with a method: `exact` or `paper` (operators of dvct), or NAME[-OPERATOR].

    An installed plugin's, too. A method that the scene has keeps its settings.

    Raises:
        DeltalightError: there is no such method.
    """
    from deltalight.protocol.methods import PLUGINS

    if require_method(method) in ("exact", "paper"):
        name, operator = "dvct", method
    else:
        name, _, operator = (method, "", "") if method in PLUGINS.values else method.partition("-")
    chosen = scene if scene.method.method_name() == name else scene.replaced(method={"name": name})
    return chosen.replaced(method=chosen.method.replaced(operator=operator)) if operator else chosen
