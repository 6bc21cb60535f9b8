"""A scene that code can change: objects added, moved and removed."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from deltalight.protocol.array_checks import kind_of
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import replacing, require_path
from deltalight.protocol.scene import SceneDocument, load_scene, resolve_asset
from deltalight.protocol.scene_objects import MESH_SUFFIXES, Material, SceneObject

Vector = Sequence[float] | Float[np.ndarray, "..."]


class Scene:
    """Virtual objects, lights and settings: a scene document (docs/formats.md 3), replaced with every change.

    The world is the marker board's frame: origin at the top-left corner of its first marker, +x right, +y up the
    sheet, +z out of the paper; metres.
    """

    def __init__(self, document: SceneDocument | None = None) -> None:
        """Takes a document, such as one of `parse_scene`; None: an empty one.

        Raises:
            DeltalightError: it is something else.
        """
        self.document = SceneDocument() if document is None else document
        if not isinstance(self.document, SceneDocument):
            raise DeltalightError(
                f"A scene document is needed and {kind_of(document)} was given; make one with"
                " `deltalight.protocol.scene.parse_scene`, or load a file with `Scene.load`."
            )

    def __repr__(self) -> str:
        return f"<Scene with {', '.join(self._names()) or 'no objects'}>"

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a scene document (JSON or YAML); its assets are relative to it.

        Raises:
            DeltalightError: it is no path; or the file, a key or an asset is missing or wrong.
        """
        return cls(load_scene(require_path(path, "The path of a scene document")))

    def save(self, path: str | Path) -> None:
        """Writes the scene document as JSON; its assets stay where they are.

        Raises:
            DeltalightError: it is no path, or the file cannot be written.
        """
        text = json.dumps(self.document.model_dump(mode="json"), indent=2, ensure_ascii=False)
        with replacing(require_path(path, "The path of a scene document")) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    def add(
        self,
        asset: str | Path,
        *,
        at: Vector = (0.0, 0.0, 0.0),
        name: str | None = None,
        scale: float = 1.0,
        rotation_wxyz: Vector = (1.0, 0.0, 0.0, 0.0),
        material: Material | None = None,
    ) -> str:
        """Adds an object and returns its name.

        Args:
            asset: a mesh (.glb, .gltf, .obj, .ply, .stl), relative to the working folder.
            at: position of its origin in the world, m.
            name: its id; default: the asset's name, with a number if that is taken.
            scale: a factor on the asset, which is assumed to be in metres.
            rotation_wxyz: its rotation, as a quaternion.
            material: replaces the asset's own.

        Raises:
            DeltalightError: there is no such file, the name is taken, or a value does not fit.
        """
        found = _found(asset)
        name = self._free_name(found.stem) if name is None else name
        if name in self._names():
            raise DeltalightError(f"The scene has an object `{name}` already; give another name.")
        pose = {"translation_m": _numbers(at), "rotation_wxyz": _numbers(rotation_wxyz), "scale": scale}
        fields = {"id": name, "asset": str(found), "pose": pose, "material": material}
        added = validate(SceneObject, fields, f"the object `{name}`")
        self.document = self.document.replaced(objects=(*self.document.objects, added))
        return name

    def change(self, name: str, **fields: Any) -> None:  # noqa: ANN401 (whatever an object has)
        """Changes fields of an object, such as `pose`, `material` or `visible`.

        A new `asset` is relative to the working folder, as with `add`.

        Raises:
            DeltalightError: there is no such object or file, or a field does not fit.
        """
        self._require(name)
        if "asset" in fields:
            fields["asset"] = str(_found(fields["asset"]))
        objects = [item.replaced(**fields) if item.id == name else item for item in self.document.objects]
        self.document = self.document.replaced(objects=tuple(objects))

    def move(self, name: str, to: Vector) -> None:
        """Moves an object's origin to a position in the world, m; rotation and scale stay.

        Raises:
            DeltalightError: there is no such object, or no such position.
        """
        self.change(name, pose=self._require(name).pose.replaced(translation_m=_numbers(to)))

    def remove(self, name: str) -> None:
        """Removes an object.

        Raises:
            DeltalightError: there is no such object.
        """
        self._require(name)
        kept = tuple(item for item in self.document.objects if item.id != name)
        self.document = self.document.replaced(objects=kept)

    def _names(self) -> list[str]:
        return [item.id for item in self.document.objects]

    def _free_name(self, stem: str) -> str:
        taken = self._names()
        numbered = (f"{stem} {number}" for number in range(2, len(taken) + 3))
        return next(name for name in (stem, *numbered) if name not in taken)

    def _require(self, name: str) -> SceneObject:
        for item in self.document.objects:
            if item.id == name:
                return item
        known = ", ".join(self._names()) or "none"
        raise DeltalightError(f"The scene has no object `{name}`; it has: {known}.")


def _found(asset: str | Path) -> Path:
    asset = require_path(asset, "The path of a mesh")
    path = Path(resolve_asset(str(asset), Path.cwd()))
    if path.is_dir():
        raise DeltalightError(f"{asset} is a folder; name a mesh file.")
    if not path.is_file():
        raise DeltalightError(f"{asset} does not exist; correct the path.")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise DeltalightError(f"{asset} is not a mesh file; use one of {', '.join(MESH_SUFFIXES)}.")
    return path


def _numbers(vector: object) -> object:
    """A vector as a tuple, as documents have it; what is none stays, so that validation refuses it."""
    return tuple(vector) if isinstance(vector, Iterable) else vector
