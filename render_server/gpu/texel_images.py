"""What software renderers read from images where shaders name samplers and storage buffers.

For a vector, Mesa's llvmpipe takes 2 ns of a core to load it from an image, 4 to fetch it by `texelFetch`, which
heeds the sampler's levels and limits, and 30 to read it from a storage buffer, lane by lane and number by number. So
sources are rewritten for it:

* `#pragma texels FORMAT NAME ...` beside the declarations says that the textures of these samplers have that format,
  as images must know. Samplers that are only fetched from become images;
* arrays of read-only storage buffers become images of the same name, to which gpu/buffer_images.py binds the buffers.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from deltalight.render_server.gpu.shader_source import preprocessed, without_comments

_PRAGMA = re.compile(r"#pragma texels (\w+) (.+)")
_IMAGES = re.compile(r"image(?:2D|3D|2DArray) \w")
_BLOCK = re.compile(r"layout\(std430\) (\w+) buffer (\w+) \{([^}]*?)(\w+) (\w+)\[\]; \}")
_STRUCT = re.compile(r"struct (\w+) \{([^}]*)\}")
_MEMBER = re.compile(r"\s*(\w+) \w+(?:\[(\d+)\])?")
_SAMPLER = re.compile(r"uniform ([iu]?sampler(?:2D|3D|2DArray)) (\w+);")
_ELEMENTS: Final = {  # of an array: format and type of the image, components that hold one
    "uint": ("r32ui", "uimageBuffer", "r"),
    "int": ("r32i", "iimageBuffer", "r"),
    "float": ("r32f", "imageBuffer", "r"),
    "vec2": ("rg32f", "imageBuffer", "rg"),
    "uvec2": ("rg32ui", "uimageBuffer", "rg"),
    "vec4": ("rgba32f", "imageBuffer", "rgba"),
}


@lru_cache(maxsize=512)  # as of declarations(): renderers are made again and again
def with_images(source: str, most_images: int) -> str:
    """Returns the source with images in place of samplers and storage buffers; those beyond `most_images` stay.

    Raises:
        ValueError: another level than 0 is fetched from a sampler of a `texels` pragma.
    """
    code = _PRAGMA.sub("", without_comments(source))
    room = max(most_images - len(_IMAGES.findall(code)), 0)
    formats = {name: texels for texels, names in _PRAGMA.findall(source) for name in names.split()}
    declared = _SAMPLER.findall(code)
    kinds = {name: [kind for kind, other in declared if other == name] for name in formats}
    samplers = [name for name in formats if _is_only_fetched(code, name, len(kinds[name]))][:room]
    for name in samplers:
        source = _without_sampler(source, name, kinds[name], formats[name])
    for array in list(_arrays(source))[: room - len(samplers)]:
        source = array.replaced(source)
    return source


def _is_only_fetched(code: str, name: str, declared: int) -> bool:
    """Whether a sampler, `declared` so often, is fetched from and used in no other way."""
    fetches = code.count(f"texelFetch({name}, ") if declared else 0
    known = fetches + declared + code.count(f"textureSize({name}, 0)") if fetches else 0
    return known > 0 and known == len(list(_places(code, name)))


def _places(text: str, word: str) -> Iterator[int]:
    """Where a word stands in a text; for so long texts, far faster than a regular expression."""
    at = text.find(word)
    while at >= 0:
        before, after = text[at - 1], text[at + len(word)]
        if not (before.isalnum() or after.isalnum() or before in "_." or after == "_"):
            yield at
        at = text.find(word, at + len(word))


def _without_sampler(source: str, name: str, kinds: Collection[str], texels: str) -> str:
    for kind in set(kinds):
        image = f"layout({texels}) restrict readonly uniform {kind.replace('sampler', 'image')} {name};"
        source = source.replace(f"uniform {kind} {name};", image)
    source = source.replace(f"textureSize({name}, 0)", f"imageSize({name})")
    head = f"texelFetch({name}, "
    # From the last one on, so that those in arguments are replaced before.
    while (at := source.rfind(head)) >= 0:
        arguments, rest = until_bracket(source, at + len(head), "(", ")")
        place, comma, level = arguments.rpartition(", ")
        if not comma or level != "0":
            raise ValueError(f"`{name}` has `#pragma texels`, but {arguments} is not of level 0.")
        source = f"{source[:at]}imageLoad({name}, {place}){rest}"
    return source


def until_bracket(text: str, start: int, opening: str, closing: str) -> tuple[str, str]:
    """Splits a text, from `start` on, at the bracket that closes the one before."""
    end = text.index(closing, start)
    while text.count(opening, start, end) > text.count(closing, start, end):
        end = text.index(closing, end + 1)
    return text[start:end], text[end + 1 :]


@dataclass(frozen=True)
class _Array:
    """An array without end, of vectors or structs of them, in a block, after unsigned integers, the header."""

    block: str
    header: tuple[str, ...]
    element: str
    name: str
    structs: Mapping[str, str]

    @property
    def _texel(self) -> tuple[str, str, str]:
        return _ELEMENTS.get(self.element, _ELEMENTS["vec4"])

    @property
    def size(self) -> int:
        """Texels of an element, 0 if it is a struct of other than vectors of four numbers, one a declaration."""
        return 1 if self.element in _ELEMENTS else self._vectors(self.element)

    def _vectors(self, kind: str) -> int:
        if kind == "vec4":
            return 1
        members = [(self._vectors(member), int(times or 1)) for member, times in self._members(kind)]
        return sum(count * times for count, times in members) if all(count for count, _ in members) else 0

    def _members(self, kind: str) -> list[tuple[str, str]]:
        """Kinds of a struct's members and how many of an array; no kind for what this does not understand."""
        declared = [text for text in self.structs.get(kind, "").split(";") if text.strip()]
        found = [_MEMBER.fullmatch(text) for text in declared]
        return [("", "") if each is None else (each[1], each[2] or "") for each in found]

    def replaced(self, source: str) -> str:
        """Returns the source with an image for the block, which a function reads."""
        texels, image, components = self._texel
        first, read = -(-len(self.header) // len(components)), f"{self.name}_read"
        places = iter(range(self.size))
        body = f"int at = {first} + {self.size} * int(i); return {self._read(self.element, places)};"
        declared = f"layout({texels}) restrict readonly uniform {image} {self.block};"
        source = self._without_block(source, f"{declared} {self.element} {read}(uint i) {{ {body} }}")
        length = f"((imageSize({self.block}) - {first}) / {self.size})"
        source = source.replace(f"{self.name}.length()", length)
        for index, number in enumerate(self.header):
            source = self._with_number(source, index, number)
        for at in reversed([at for at in _places(source, self.name) if source[at + len(self.name)] == "["]):
            index_text, rest = until_bracket(source, at + len(self.name) + 1, "[", "]")
            source = f"{source[:at]}{read}(uint({index_text})){rest}"
        return source

    def _read(self, kind: str, places: Iterator[int]) -> str:
        if kind == self.element in _ELEMENTS or kind == "vec4":
            return f"imageLoad({self.block}, at + {next(places)}).{self._texel[2]}"
        parts = [self._member(member, times, places) for member, times in self._members(kind)]
        return f"{kind}({', '.join(parts)})"

    def _member(self, kind: str, times: str, places: Iterator[int]) -> str:
        if not times:
            return self._read(kind, places)
        return f"{kind}[{times}]({', '.join(self._read(kind, places) for _ in range(int(times)))})"

    def declares_every_block_in(self, source: str) -> bool:
        """Whether all that is declared under the block's name, in branches too, has the form that is replaced."""
        form = rf"layout\(std430\) (?:\w+ )?buffer {self.block} \{{"
        return len(re.findall(form, source)) == source.count(f"buffer {self.block} {{")

    def _without_block(self, source: str, image: str) -> str:
        head = f"buffer {self.block} {{"
        while (at := source.find(head)) >= 0:  # more than one where branches declare it in other ways
            start, end = source.rindex("layout(std430)", 0, at), source.index("};", at) + 2
            source = source[:start] + image + source[end:]
        return source

    def _with_number(self, source: str, index: int, number: str) -> str:
        """Replaces a number of the header."""
        texels, _, components = self._texel
        read = f"imageLoad({self.block}, {index // len(components)}).{components[index % len(components)]}"
        read = read if "ui" in texels else f"floatBitsToUint({read})" if "f" in texels else f"uint({read})"
        for at in reversed(list(_places(source, number))):
            source = source[:at] + read + source[at + len(number) :]
        return source


def _arrays(source: str) -> Iterator[_Array]:
    """Arrays of read-only storage buffers whose elements are vectors of one kind."""
    kept, macros = preprocessed(source)
    structs = dict(_STRUCT.findall(kept))
    for access, block, before, element, name in _BLOCK.findall(kept):
        header = [words.split() for words in before.split(";") if words.strip()]
        array = _Array(block, tuple(number for _, number in header), element, name, structs)
        is_read_only = macros.get(access, access) == "readonly" and array.declares_every_block_in(source)
        if is_read_only and array.size and all(kind == "uint" for kind, _ in header):
            yield array
