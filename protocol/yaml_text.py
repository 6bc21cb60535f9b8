"""YAML as text of documents: reading within limits, because YAML can say much in few bytes, and writing."""

import re
import time
from collections.abc import Mapping
from typing import Any

import yaml

MAX_VALUES = 100_000  # twice those of a scene with the maximum number of objects and all keys written out
MAX_DEPTH = 32
MAX_TEXT = 4096  # characters of one value: the longest that a scene document may hold
MAX_SECONDS = 5.0
MAX_INTEGER = 2**64
MAX_KEY_SHOWN = 64


# Ten times as fast as the loader in Python; a PyYAML that was built without libyaml has that one only.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads `1e-3` as a number, as in YAML 1.2, and refuses a key that a mapping already has.

    In YAML 1.1 the former is a string, and PyYAML would keep the last value of a key.
    """


class _Dumper(yaml.SafeDumper):
    """Quotes strings that `_Loader` would take for numbers."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )


def parse_yaml(text: str) -> Any:  # noqa: ANN401 - whatever the text holds
    """Returns the data of a YAML document.

    Raises:
        ValueError: the text is no YAML, takes more than a document may, or has a key twice in one mapping.
    """
    try:
        _require_limits(text)
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ArithmeticError, RecursionError) as error:  # 1:60:60... is a number in YAML 1.1
        raise ValueError(str(error).replace('in "<unicode string>",', "at")) from error


def _integer(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    value = int(loader.construct_yaml_int(node))
    if abs(value) >= MAX_INTEGER:
        raise yaml.constructor.ConstructorError(
            None, None, "an integer has more than 64 bits", node.start_mark
        )
    return value


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def _unique_mapping(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    found: set[str] = set()
    for key, _ in node.value:
        if isinstance(key, yaml.ScalarNode):
            if key.value in found:
                raise yaml.constructor.ConstructorError(
                    None, None, f"`{key.value[:MAX_KEY_SHOWN]}` appears twice", key.start_mark
                )
            found.add(key.value)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:map", _unique_mapping)


def yaml_text(data: Mapping[str, Any]) -> str:
    """Returns the YAML of a document with its keys in order, which `parse_yaml` reads back."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def _require_limits(text: str) -> None:
    """Refuses what is too much before anything is built; an alias counts as all that it stands for."""
    ends_s = time.monotonic() + MAX_SECONDS
    count = 0
    sizes: dict[str | None, int] = {}  # of what has an anchor and is complete
    begun: list[tuple[str | None, int]] = []
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = begun.pop()
            sizes[anchor] = count - before
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise ValueError(f"the alias `*{event.anchor:.60}` stands for nothing that is complete")
            count += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent | yaml.ScalarEvent):
            _require_plain(event)
            if isinstance(event, yaml.CollectionStartEvent):
                begun.append((event.anchor, count))
            else:
                sizes[event.anchor] = 1
            count += 1
        if len(begun) > MAX_DEPTH:
            raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels")
        if count > MAX_VALUES:
            raise ValueError(
                f"it has more than {MAX_VALUES} values, an alias counted as all that it stands for"
            )
        if time.monotonic() > ends_s:
            raise ValueError(f"it takes longer than {MAX_SECONDS:.0f} s to read")


def _require_plain(event: yaml.CollectionStartEvent | yaml.ScalarEvent) -> None:
    if event.tag is not None:
        raise ValueError(f"the tag {event.tag:.60} is not needed in a document")
    if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_TEXT:
        raise ValueError(f"a value has more than {MAX_TEXT} characters")
