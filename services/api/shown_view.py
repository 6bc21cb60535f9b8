"""The view that the live picture shows: looking at the scene in another way is no change of the scene."""

from collections.abc import Callable
from typing import Literal

from deltalight.protocol.scene import SceneDocument
from deltalight.services.storage.scenes import StoredScene

View = Literal["composite", "effects", "delta", "volume", "rsm", "lights"]


class ShownView:
    """A view in place of the document's own, until another scene or another view of the document takes over."""

    def __init__(self, on_change: Callable[[View | None], None] = lambda _view: None) -> None:
        self.chosen: View | None = None
        self._of: tuple[str, str] | None = None  # the scene and its own view when it was chosen
        self._on_change = on_change

    def choose(self, view: View | None, active: StoredScene | None) -> None:
        """Show a view from now on; None = as the document says."""
        self._of = None if active is None else _own_view(active)
        self._become(view)

    def applied(self, active: StoredScene) -> SceneDocument:
        """Return the document as it is to be rendered."""
        if self.chosen is not None and self._of not in (None, _own_view(active)):
            self._become(None)
        if self.chosen is None:
            return active.document
        document = active.document
        return document.replaced(output=document.output.replaced(view=self.chosen))

    def _become(self, view: View | None) -> None:
        changed, self.chosen = view != self.chosen, view
        if changed:
            self._on_change(view)


def _own_view(scene: StoredScene) -> tuple[str, str]:
    return scene.head.id, scene.document.output.view
