"""Documents of a drag: what did not change stays the same object, and all is validated as ever."""

import json
from typing import Any

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import parse_scene
from deltalight.render_server.server.scene_reader import SceneReader

PLACES = ([0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0])


def document(*places: list[float]) -> dict[str, Any]:
    """As it arrives: nothing of it is an object of an earlier one."""
    objects = [{"asset": "box.ply", "pose": {"translation_m": place}} for place in places]
    lights = {"manual": [{"type": "ambient", "radiance": 0.5}]}
    found: dict[str, Any] = json.loads(json.dumps({"objects": objects, "lights": lights, "revision": 3}))
    return found


def test_what_a_drag_leaves_alone_stays_the_same_object() -> None:
    reader = SceneReader()
    before = reader.read(document(*PLACES))
    data = {**document([0.15, 0, 0], *PLACES[1:]), "revision": 4}
    after = reader.read(data)
    assert after == parse_scene(data)
    assert after.objects[1] is before.objects[1]
    assert after.objects[2] is before.objects[2]
    assert after.lights is before.lights
    assert reader.read(document(*PLACES)) == before


@pytest.mark.parametrize("places", [PLACES[1:], PLACES[:2], (*PLACES, [0.4, 0, 0]), PLACES[::-1], ()])
def test_objects_that_come_or_go_are_named_as_in_a_new_document(places: tuple[list[float], ...]) -> None:
    reader = SceneReader()
    reader.read(document(*PLACES))
    assert reader.read(document(*places)) == parse_scene(document(*places))


def test_a_fault_is_named_as_in_a_new_document_and_changes_nothing() -> None:
    reader = SceneReader()
    before = reader.read(document(*PLACES))
    for path, value in ((("objects", 1, "pose", "scale"), -1), (("objects",), 5), (("light",), {})):
        faulty: Any = document(*PLACES)
        target = faulty
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value
        with pytest.raises(DeltalightError) as expected:
            parse_scene(faulty)
        with pytest.raises(DeltalightError) as found:
            reader.read(faulty)
        assert str(found.value) == str(expected.value)
    assert reader.read(document(*PLACES)).objects == before.objects
