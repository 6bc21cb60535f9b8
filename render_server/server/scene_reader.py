"""Scene documents as they arrive: what is as in the one before is not validated again."""

from collections.abc import Mapping
from typing import Any

from deltalight.protocol.scene import SceneDocument, parse_scene


class SceneReader:
    """Validates scene documents; parts whose data are as in the last one stay the same objects.

    Each step of a drag sends the whole document, of which all but one object is as before.
    """

    def __init__(self) -> None:
        self._data: Mapping[str, Any] = {}
        self._scene = SceneDocument()

    def read(self, data: Mapping[str, Any]) -> SceneDocument:
        """Returns the document as `parse_scene` does.

        Raises:
            DeltalightError: the first fault, with its place in the document.
        """
        scene = parse_scene({**data, **self._kept(data)})
        self._data, self._scene = data, scene
        return scene

    def _kept(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """Returns what takes the place of data: parts of the last document, where theirs were the same."""
        before, scene = self._data, self._scene
        same = {key: getattr(scene, key) for key in data if key in before and data[key] == before[key]}
        if "objects" in same or not isinstance(data.get("objects"), list) or "objects" not in before:
            return same
        objects = list(data["objects"])
        for index, (item, old) in enumerate(zip(objects, before["objects"], strict=False)):
            if item == old:
                objects[index] = scene.objects[index]
        return {**same, "objects": objects}
