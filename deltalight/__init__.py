"""Mixed-reality relighting; the parts are subpackages, such as `deltalight.protocol` and `deltalight.services`.

    import deltalight as dl

    take, scene = dl.open("desk.mcap"), dl.Scene.load("scene.json")
    with dl.Renderer(method="dvct") as renderer:
        for frame in take[::10]:
            picture = renderer.render(frame, scene)

A wheel holds the parts inside this folder. In a checkout they are the folders beside it. Importing this package
imports nothing else; the public names are imported when they are first used (PEP 562).
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from deltalight.protocol.errors import DeltalightError
    from deltalight.protocol.scene_objects import Material
    from deltalight.relighting import RelitPicture, Renderer
    from deltalight.scene import Scene
    from deltalight.take import LiveTake, Take
    from deltalight.take import open_take as open

__version__ = "0.1.0"

__all__ = [
    "DeltalightError",
    "LiveTake",
    "Material",
    "RelitPicture",
    "Renderer",
    "Scene",
    "Take",
    "__version__",
    "open",
]

_PACKAGE = Path(__file__).parent

if not (_PACKAGE / "protocol").is_dir():  # a checkout
    __path__.append(str(_PACKAGE.parent))

_PUBLIC = {
    "DeltalightError": ("protocol.errors", "DeltalightError"),
    "LiveTake": ("take", "LiveTake"),
    "Material": ("protocol.scene_objects", "Material"),
    "RelitPicture": ("relighting", "RelitPicture"),
    "Renderer": ("relighting", "Renderer"),
    "Scene": ("scene", "Scene"),
    "Take": ("take", "Take"),
    "open": ("take", "open_take"),
}


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PUBLIC[name]
    value = globals()[name] = getattr(import_module(f"{__name__}.{module}"), attribute)
    return value
