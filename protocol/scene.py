"""The scene document (docs/formats.md 3): models, loading from JSON or YAML, JSON Schema."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import Field, field_validator, model_validator

from deltalight.protocol.documents import StrictModel, read_mapping, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import is_file
from deltalight.protocol.methods import Method
from deltalight.protocol.scene_fields import Text
from deltalight.protocol.scene_lights import Lights, default_lights
from deltalight.protocol.scene_method import DvctMethod
from deltalight.protocol.scene_objects import ModelGeometry, PrecomputedMaterial, RealScene, SceneObject
from deltalight.protocol.scene_output import Output, Shading

DIGEST_PREFIX = "sha256:"


class SceneDocument(StrictModel):
    """Everything that is to be seen beside the camera picture, and how (docs/formats.md 3).

    World = the marker board's frame: origin at the top-left corner of its first marker, +x right, +y up the
    sheet, +z out of the paper; metres. Radiometry in camera units (1.0 = sensor white at the reference
    exposure).
    """

    name: Text = Field(default="", max_length=200, description="Title to display.")
    revision: int = Field(default=0, ge=0, description="Increases with every change.")
    real: RealScene = Field(default_factory=RealScene)
    objects: tuple[SceneObject, ...] = Field(
        default=(), max_length=1024, fail_fast=True, description="Virtual objects."
    )
    lights: Lights = Field(default_factory=default_lights)
    method: Method = Field(default_factory=DvctMethod, description="Relighting method; default dvct.")
    shading: Shading = Field(default_factory=Shading)
    output: Output = Field(default_factory=Output)

    @field_validator("objects", mode="before")
    @classmethod
    def _name_objects(cls, value: Any) -> Any:  # noqa: ANN401 - whatever the document holds
        if not isinstance(value, (list, tuple)):
            return value
        return tuple(
            {"id": f"object{index}", **item} if isinstance(item, Mapping) else item
            for index, item in enumerate(value)
        )

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [item.id for item in self.objects]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise ValueError(f"two objects have the id `{name}`, but every id must be unique")
        return self

    def canonical_json(self) -> str:
        """Returns the document as JSON with sorted keys and no spaces: equal documents give equal text."""
        return json.dumps(
            self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), ensure_ascii=False
        )

    def with_assets(self, rename: Callable[[str, str], str]) -> "SceneDocument":
        """Returns the document with every asset replaced by `rename(place, asset)`, e.g. to resolve paths."""
        real, environment = self.real, self.lights.environment
        if isinstance(real.geometry, ModelGeometry):
            model = rename("real.geometry.model", real.geometry.model)
            real = real.replaced(geometry=real.geometry.replaced(model=model))
        if environment.map is not None:
            environment = environment.replaced(map=rename("lights.environment.map", environment.map))
        objects = tuple(
            _with_object_assets(f"objects[{index}]", item, rename) for index, item in enumerate(self.objects)
        )
        return self.replaced(real=real, objects=objects, lights=self.lights.replaced(environment=environment))


def _with_object_assets(place: str, item: SceneObject, rename: Callable[[str, str], str]) -> SceneObject:
    changes: dict[str, object] = {"asset": rename(f"{place}.asset", item.asset)}
    if isinstance(item.material, PrecomputedMaterial):
        asset = rename(f"{place}.material.precomputed", item.material.precomputed)
        changes["material"] = PrecomputedMaterial(precomputed=asset)
    return item.replaced(**changes)


def parse_scene(data: Mapping[str, Any], name: str = "the scene document") -> SceneDocument:
    """Validates a scene document; assets stay as written.

    Raises:
        DeltalightError: the first fault, with its place in the document.
    """
    return validate(SceneDocument, data, name)


def load_scene(path: Path) -> SceneDocument:
    """Reads a scene document (JSON or YAML) and makes its asset paths absolute, relative to the document.

    Raises:
        DeltalightError: the file, a key or an asset is missing or wrong.
    """
    scene = parse_scene(read_mapping(path), str(path))

    def find(place: str, asset: str) -> str:
        found = resolve_asset(asset, path.parent)
        if not found.startswith(DIGEST_PREFIX) and not is_file(Path(found)):
            raise DeltalightError(f"{path}: `{place}` names {found}, which does not exist; correct the path.")
        return found

    return scene.with_assets(find)


def resolve_asset(asset: str, folder: Path) -> str:
    """Returns an asset's absolute path, read relative to `folder`; a `sha256:` name stays.

    Raises:
        DeltalightError: it is no name that a file can have.
    """
    if asset.startswith(DIGEST_PREFIX):
        return asset
    try:
        return str((folder / asset).resolve())
    except (ValueError, OSError, RuntimeError) as error:  # a null byte; a link to itself
        raise DeltalightError(f"{asset!r:.200} is not a file name ({error}); correct the path.") from error


def scene_json_schema() -> dict[str, Any]:
    """Returns the JSON Schema of the scene document."""
    return SceneDocument.model_json_schema()
