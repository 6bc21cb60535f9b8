"""Texels that software renderers load from images where shaders fetch them from samplers.

Mesa's llvmpipe loads a texel of an image in half of the time that `texelFetch` takes, which heeds levels and limits of the
sampler (2 and 4 ns of a core). `#pragma texels FORMAT NAME ...` beside the declarations says that the textures of these
samplers have that format, as images must know.
"""

import re
from functools import lru_cache

_PRAGMA = re.compile(r"^#pragma texels (\w+) (.+)$", re.MULTILINE)
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_IMAGES = re.compile(r"\b[iu]?image(?:2D|3D|2DArray) \w+")


@lru_cache(maxsize=512)  # as of declarations(): renderers are made again and again
def texels_as_images(source: str, most_images: int) -> str:
    """Returns the source with loads from images for every sampler of a `texels` pragma that is only fetched from.

    Samplers beyond `most_images` of a shader stay.

    Raises:
        ValueError: another level than 0 is fetched.
    """
    formats = {name: texels for texels, names in _PRAGMA.findall(source) for name in names.split()}
    if not formats:
        return source
    code = _PRAGMA.sub("", _COMMENT.sub(" ", source))
    room = max(most_images - len(_IMAGES.findall(code)), 0)
    for name in [name for name in formats if _is_only_fetched(code, name)][:room]:
        declared = rf"\buniform ([iu]?)sampler(2D|3D|2DArray) {name};"
        image = rf"layout({formats[name]}) readonly uniform \1image\2 {name};"
        source = re.sub(declared, image, source).replace(f"textureSize({name}, 0)", f"imageSize({name})")
        source = _with_loads(source, name)
    return source


def _is_only_fetched(code: str, name: str) -> bool:
    fetches = code.count(f"texelFetch({name}, ")
    declared = len(re.findall(rf"\buniform [iu]?sampler(?:2D|3D|2DArray) {name};", code))
    known = fetches + declared + code.count(f"textureSize({name}, 0)")
    return fetches > 0 and declared > 0 and known == len(re.findall(rf"\b{name}\b", code))


def _with_loads(source: str, name: str) -> str:
    """Replaces `texelFetch(name, place, 0)` by `imageLoad(name, place)`."""
    head = f"texelFetch({name}, "
    while (
        at := source.rfind(head)
    ) >= 0:  # from the last one on, so that those in arguments are replaced before
        source = f"{source[:at]}imageLoad({name}, {_without_level(source[at + len(head) :], name)}"
    return source


def _without_level(fetch: str, name: str) -> str:
    """Removes the level, 0, from what follows the beginning of a fetch."""
    depth, end = 1, 0
    while depth > 0:
        depth += {"(": 1, ")": -1}.get(fetch[end], 0)
        end += 1
    arguments = fetch[: end - 1]
    place, comma, level = arguments.rpartition(", ")
    if not comma or level != "0":
        raise ValueError(f"`{name}` has `#pragma texels`, but {arguments} is not of level 0.")
    return place + fetch[end - 1 :]
