"""Reading JSON and YAML documents, and reporting validation errors as one sentence."""

import difflib
import json
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.yaml_text import parse_yaml

Model = TypeVar("Model", bound=BaseModel)
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"  # of nodes, cameras and rooms
LONGEST_WORD = 200  # characters of a word that are compared and shown: longer than any known one


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Returns the known word most similar to `word`, or None if none is similar."""
    by_lower = {name.lower(): name for name in known}
    found = difflib.get_close_matches(word[:LONGEST_WORD].lower(), by_lower, n=1, cutoff=0.4)
    return by_lower[found[0]] if found else None


class StrictModel(BaseModel):
    """A frozen model that refuses unknown keys (suggesting the nearest) and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:  # noqa: ANN401 - whatever the document holds
        if isinstance(data, Mapping):
            for key in data:
                if key not in cls.model_fields:
                    known = sorted(cls.model_fields)
                    hint = nearest(str(key), known)
                    advice = (
                        f"the nearest known key is `{hint}`" if hint else f"known keys are {', '.join(known)}"
                    )
                    raise PydanticCustomError("unknown_key", "{advice}", {"key": str(key), "advice": advice})
        return data

    def replaced(self, **changes: object) -> Self:
        """Returns a validated copy with some fields changed.

        Raises:
            DeltalightError: there is no such field, or a value does not fit.
        """
        return validate(type(self), {**dict(self), **changes}, type(self).__name__)


def read_mapping(path: Path) -> dict[str, Any]:
    """Reads a JSON (`.json`) or YAML document whose top level is a mapping.

    Raises:
        DeltalightError: the file is missing, unreadable, malformed or no mapping, or has a key twice in one place.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DeltalightError(
            f"{path} cannot be read ({error.strerror}); give a file that exists."
        ) from error
    except UnicodeDecodeError as error:
        raise DeltalightError(f"{path} is not a text file; give a JSON or YAML document.") from error
    is_json = path.suffix.lower() == ".json"
    return parse_mapping(text, str(path), is_json=is_json)


def parse_mapping(text: str, name: str, *, is_json: bool) -> dict[str, Any]:
    """Parses the text of a document called `name` whose top level is a mapping.

    Raises:
        DeltalightError: the text is malformed or not a mapping, or has a key twice in one place.
    """
    kind = "JSON" if is_json else "YAML"
    if not text.strip():
        raise DeltalightError(f"{name} is empty; write {kind} with keys and values.")
    try:
        data = json.loads(text, object_pairs_hook=_unique) if is_json else parse_yaml(text)
    except (ValueError, RecursionError) as error:
        limit = beyond_limits(error)
        if limit is not None:
            raise DeltalightError(f"{name} {limit}.") from error
        if isinstance(error, _DoubledKeyError):
            raise DeltalightError(f"{name}: {error}; remove one of them.") from error
        detail = " ".join(str(error).split())[:160]
        raise DeltalightError(f"{name} is not valid {kind} ({detail}); correct it there.") from error
    if not isinstance(data, dict):
        raise DeltalightError(
            f"{name} must hold keys and values, not a {type(data).__name__}; write `key: value` lines."
        )
    return data


def beyond_limits(error: ValueError | RecursionError) -> str | None:
    """Returns what is too much about a text that Python refused to parse; None: it is malformed."""
    if isinstance(error, RecursionError):
        return "is nested too deeply; give the keys that a document has"
    if str(error).startswith("Exceeds the limit"):  # json.JSONDecodeError has other words
        return f"has a number of more than {sys.get_int_max_str_digits()} digits; give a shorter one"
    return None


class _DoubledKeyError(ValueError):
    """An object of JSON has a key twice, which its grammar allows."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        ((doubled, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise _DoubledKeyError(f"`{doubled[:LONGEST_WORD]}` appears twice")
    return found


def validate(model: type[Model], data: Mapping[str, Any], name: str, *, strict: bool = False) -> Model:
    """Validates a document called `name` against a model.

    `strict`: strings and booleans are not numbers, as in the model's JSON schema; otherwise `"2"` and `true` count as
    numbers too, which is how they come from the environment.

    Raises:
        DeltalightError: the first fault, as one sentence with its place in the document.
    """
    try:
        return model.model_validate(_plain(data, {}), strict=True) if strict else model.model_validate(data)
    except ValidationError as error:
        raise DeltalightError(f"{name}: {_first_fault(error, data)}") from error
    except RecursionError as error:
        raise DeltalightError(f"{name} is nested too deeply; send the keys that it has.") from error


def _first_fault(error: ValidationError, document: Mapping[str, Any]) -> str:
    try:
        return _sentence(error.errors(include_url=False)[0], document)
    except UnicodeEncodeError:  # pydantic cannot show it
        return "it holds text with a lone surrogate; correct it."


def _plain(value: Any, known: dict[int, Any]) -> Any:  # noqa: ANN401 - JSON
    """Converts JSON for strict models: arrays become tuples and 2.0 the integer 2, as JSON has one kind of number.

    A shared part is converted once: YAML can alias a part many times, which must not become as many copies.
    """
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if not isinstance(value, (Mapping, list, tuple)):
        return value
    if id(value) not in known:
        if isinstance(value, Mapping):
            known[id(value)] = {key: _plain(each, known) for key, each in value.items()}
        else:
            known[id(value)] = tuple(_plain(each, known) for each in value)
    return known[id(value)]


def _sentence(fault: ErrorDetails, document: Mapping[str, Any]) -> str:
    place = _place(fault, document)
    context = fault.get("ctx", {})
    match fault["type"]:
        case "unknown_key":
            key = context["key"][:LONGEST_WORD]
            where = f"{place}.{key}" if place else key
            return f"unknown key `{where}`; {context['advice']}."
        case "missing":
            return f"the key `{place}` is missing; add it."
        case "union_tag_invalid":
            tag = str(context["tag"])[:LONGEST_WORD]
            expected = [word.strip(" '") for word in str(context["expected_tags"]).split(",")]
            hint = nearest(tag, expected)
            advice = f"the nearest is `{hint}` of" if hint else "use one of"
            return f"`{place}` names the unknown kind `{tag}`; {advice} {', '.join(expected)}."
    wrong = wrong_in_words(fault)
    return f"`{place}` is wrong: {wrong}{_given(fault['input'])}." if place else f"{wrong}."


def wrong_in_words(fault: ErrorDetails) -> str:
    """Says what is wrong with a value, in JSON's words, without a full stop; places and values are the caller's."""
    context = fault.get("ctx", {})
    match fault["type"]:
        case "value_error":
            message = str(context["error"])
        case "tuple_type" | "list_type":
            message = "must be a list"
        case "model_type" | "dict_type" | "model_attributes_type":
            message = "must be an object with keys and values"
        case "string_pattern_mismatch" if context["pattern"] == NAME_PATTERN:
            message = "must be letters, digits, dashes and underscores, at most 64 that begin with a letter or digit"
        case "too_short":
            message = f"must have at least {context['min_length']} in it, and has {context['actual_length']}"
        case "too_long":
            message = f"must have at most {context['max_length']} in it, and has {context['actual_length']}"
        case _:
            message = fault["msg"]
    return (message[:1].lower() + message[1:]).rstrip(".")


def _given(value: object) -> str:
    shown = isinstance(value, (str, int, float, bool)) or value is None
    return f" (given: {value!r})"[:120] if shown else ""


def _place(fault: ErrorDetails, document: Any) -> str:  # noqa: ANN401 - whatever the document holds
    """Formats a fault's location as `a.b[0].c`, without the union tags that pydantic inserts."""
    place, here = "", document
    for index, step in enumerate(fault["loc"]):
        is_last_missing = fault["type"] == "missing" and index == len(fault["loc"]) - 1
        if isinstance(step, int):
            place += f"[{step}]"
            here = here[step] if isinstance(here, (list, tuple)) and step < len(here) else None
        elif is_last_missing or (isinstance(here, Mapping) and step in here):
            place += f".{step}" if place else step
            here = here.get(step) if isinstance(here, Mapping) else None
    return place
