"""Changes to scene documents as plain JSON: merge patches (RFC 7396), parts, objects and manual lights."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from deltalight.protocol.counts import counted
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import LIGHT_TYPES
from deltalight.services.storage.faults import NotFoundError, StaleRevisionError

Document = dict[str, Any]
Edit = Callable[[Document], Any]
Item = TypeVar("Item")


def merge_patch(target: object, patch: object) -> Any:  # noqa: ANN401 - JSON
    """Returns `target` changed by a JSON merge patch: null removes a key, so that its default holds.

    Raises:
        DeltalightError: the patch is nested too deeply.
    """
    try:
        return _merged(target, patch)
    except RecursionError as error:
        raise DeltalightError("the patch is nested too deeply; send the keys that change.") from error


def _merged(target: object, patch: object) -> object:
    if not isinstance(patch, Mapping):
        return patch
    merged = dict(target) if isinstance(target, Mapping) else {}
    for key, value in patch.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = _merged(merged.get(key), value)
    return merged


def patch_document(patch: object) -> Edit:
    """Returns an edit that merges a patch into the whole document.

    A patch that names another method starts from that method's defaults, because the methods' keys differ.
    """

    def edit(document: Document) -> Any:  # noqa: ANN401 - JSON
        return merge_patch(_prepared(document, patch), patch)

    return edit


def _prepared(document: Document, patch: object) -> Document:
    method = patch.get("method") if isinstance(patch, Mapping) else None
    name = method.get("name") if isinstance(method, Mapping) else None
    return document if name in (None, document["method"]["name"]) else {**document, "method": {}}


def patch_part(part: str, patch: object) -> Edit:
    """Returns an edit that merges a patch into one top-level part."""
    return patch_document({part: patch})


def replace_part(part: str, value: object) -> Edit:
    """Returns an edit that replaces a top-level part."""
    return lambda document: {**document, part: value}


def replace_document(value: object) -> Edit:
    """Returns an edit that replaces the document."""
    return lambda _document: value


def add_object(value: object) -> Edit:
    """Returns an edit that adds an object; one without an id gets a free one."""

    def edit(document: Document) -> Document:
        added = {"id": _free_id(document), **value} if isinstance(value, Mapping) else value
        return {**document, "objects": [*document["objects"], added]}

    return edit


def _free_id(document: Document) -> str:
    taken = {item["id"] for item in document["objects"]}
    return next(name for name in map("object{}".format, range(len(taken) + 1)) if name not in taken)


def replace_object(name: str, value: object) -> Edit:
    """Returns an edit that replaces an object; without an id the new one keeps the old one's."""
    return _edit_object(name, lambda _old: {"id": name, **value} if isinstance(value, Mapping) else value)


def patch_object(name: str, patch: object) -> Edit:
    """Returns an edit that merges a patch into one object.

    A patch from a material in numbers to a precomputed one, or back, replaces the material: they share no key.
    """
    return _edit_object(name, lambda old: merge_patch(_without_other_material(old, patch), patch))


def _without_other_material(item: Document, patch: object) -> Document:
    old, new = item.get("material"), patch.get("material") if isinstance(patch, Mapping) else None
    if not (isinstance(old, Mapping) and isinstance(new, Mapping) and new):
        return item
    return {**item, "material": None} if ("precomputed" in old) != ("precomputed" in new) else item


def _edit_object(name: str, change: Callable[[Document], Any]) -> Edit:
    def edit(document: Document) -> Document:
        index = _index(document, name)
        objects = list(document["objects"])
        objects[index] = change(objects[index])
        return {**document, "objects": objects}

    return edit


def remove_object(name: str) -> Edit:
    """Returns an edit that removes an object."""

    def edit(document: Document) -> Document:
        index = _index(document, name)
        return {**document, "objects": document["objects"][:index] + document["objects"][index + 1 :]}

    return edit


def _index(document: Document, name: str) -> int:
    for index, item in enumerate(document["objects"]):
        if item["id"] == name:
            return index
    raise NotFoundError(f"the scene has no object `{name}`; list its objects for their ids.")


def add_light(value: object) -> Edit:
    """Returns an edit that adds a manual light after the others."""
    return _edit_lights(lambda lights: [*lights, value])


def replace_light(index: int, value: object) -> Edit:
    """Returns an edit that replaces a manual light."""
    return _edit_lights(lambda lights: _with_lights(lights, index, [value]))


def patch_light(index: int, patch: object) -> Edit:
    """Returns an edit that merges a patch into one manual light.

    A patch that names another type keeps what lights of that type have too, such as place and colour.
    """

    def edit(lights: list[Any]) -> list[Any]:
        light = _for_new_type(light_at(lights, index), patch)
        return _with_lights(lights, index, [merge_patch(light, patch)])

    return _edit_lights(edit)


def _for_new_type(light: Document, patch: object) -> Document:
    named = patch.get("type") if isinstance(patch, Mapping) else None
    model = LIGHT_TYPES.get(named) if isinstance(named, str) else None
    return light if model is None else {key: light[key] for key in light if key in model.model_fields}


def remove_light(index: int) -> Edit:
    """Returns an edit that removes a manual light; those after it move up."""
    return _edit_lights(lambda lights: _with_lights(lights, index, []))


def light_at(lights: Sequence[Item], index: int) -> Item:
    """Returns one of the manual lights.

    Raises:
        NotFoundError: there are fewer.
    """
    if not 0 <= index < len(lights):
        raise NotFoundError(
            f"the scene has {counted(len(lights), 'manual light')}, counted from 0, and none at {index}."
        )
    return lights[index]


def _edit_lights(change: Callable[[list[Any]], list[Any]]) -> Edit:
    def edit(document: Document) -> Document:
        lights = document["lights"]
        return {**document, "lights": {**lights, "manual": change(lights["manual"])}}

    return edit


def _with_lights(lights: list[Any], index: int, values: list[Any]) -> list[Any]:
    """Replaces one light by any number of lights."""
    light_at(lights, index)
    return [*lights[:index], *values, *lights[index + 1 :]]


def checked_document(document: object, revision: int) -> SceneDocument:
    """Validates a document and gives it its revision.

    Raises:
        DeltalightError: the first fault, with its place.
    """
    try:
        checked = validate(SceneDocument, document, "the scene", strict=True)  # type: ignore[arg-type]
        return checked.model_copy(update={"revision": revision})
    except UnicodeEncodeError as error:
        raise DeltalightError("the scene holds text that is not valid Unicode; correct it.") from error


def require_revision(expected: int | None, current: int) -> None:
    """Refuses a change to an older revision; None = whichever is newest.

    Raises:
        StaleRevisionError: `expected` is not the newest.
    """
    if expected is not None and expected != current:
        raise StaleRevisionError(
            f"the scene is at revision {current} and the change was made to {expected}; get it and change it again.",
            current,
        )
